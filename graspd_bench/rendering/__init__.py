"""Pictures, depth images, and scenes with known truth."""
