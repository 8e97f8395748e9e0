"""Objects and clouds with deliberate faults."""
