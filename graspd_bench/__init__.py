"""The benchmark: studies, charts and tables, and what only they need."""
