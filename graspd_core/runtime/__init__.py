"""The process: arrays kept on disk, a worker process, the heap."""
