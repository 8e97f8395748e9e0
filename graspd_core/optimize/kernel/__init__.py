"""The closed form's step in C++: one start at a time, value and gradient in one pass (docs/kernel.md)."""
