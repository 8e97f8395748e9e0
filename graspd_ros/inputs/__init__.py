"""Messages to requests."""
