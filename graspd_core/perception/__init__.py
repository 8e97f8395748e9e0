"""From what cameras and files give to a scene."""
