"""Robot arms: what carries a hand, where it can bring it, and what it would hit on the way (docs/arms.md)."""
