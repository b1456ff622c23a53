"""From a trained bundle to the toy: whole numbers, C that gives the same answers, and the proof that it does."""
