"""Things in a pile on a table, seen by a camera, grasped and lifted out one after another: study `piles`."""
