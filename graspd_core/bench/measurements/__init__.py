"""One measurement each: what is asked, how it runs, what comes of it."""
