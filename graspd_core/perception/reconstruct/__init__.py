"""From points of an object to a closed mesh."""
