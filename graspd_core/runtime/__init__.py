"""Cache arrays on disk, run functions in a worker process, and read pickles safely."""
