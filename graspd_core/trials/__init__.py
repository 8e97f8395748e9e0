"""Physics trials in MuJoCo. They share no code with the methods."""
