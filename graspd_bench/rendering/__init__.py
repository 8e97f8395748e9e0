"""Rendering of pictures and depth images, and scenes whose true geometry is known."""
