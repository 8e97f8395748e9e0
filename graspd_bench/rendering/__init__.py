"""Pictures, depth images, and scenes whose truth is known."""
