"""Steps of the closed-form method in C++, with value and gradient of a start in one pass (docs/kernel.md)."""
