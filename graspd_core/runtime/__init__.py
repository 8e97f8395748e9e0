"""Support for processes: arrays cached on disk, a worker process, a safe reader of pickles."""
