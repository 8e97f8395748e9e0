"""The benchmark: studies, their charts and tables, and the code that only studies use."""
