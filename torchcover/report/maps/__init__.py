"""Maps: what was measured in every cell, seen from above."""
