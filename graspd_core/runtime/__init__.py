"""What the process keeps: arrays on disk, a worker process, the heap."""
