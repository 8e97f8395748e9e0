"""From an optimised pose to three postures: open and clear, just touching, and pressing with balanced forces.

The object is free while the hand closes, so the three are made together: every link that will touch starts clear of
the object and arrives at the end of the closing stage, and the squeeze presses with forces that cancel.
"""
