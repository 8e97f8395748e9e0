"""The benchmark: studies, charts and tables, and code that only they use."""
