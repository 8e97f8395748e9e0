"""Objects and clouds broken on purpose."""
