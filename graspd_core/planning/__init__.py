"""Planning of a run: its rounds, its restrictions, and the reasons why an object cannot be held."""
