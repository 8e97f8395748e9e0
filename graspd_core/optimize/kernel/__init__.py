"""Run the steps of the closed-form method in C++. One pass gives value and gradient of a start (docs/kernel.md)."""
