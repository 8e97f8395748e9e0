"""What a run is made of besides its searches: its clock, its rounds, and the trials of what was found."""
