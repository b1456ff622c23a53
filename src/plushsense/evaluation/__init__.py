"""How well it reads whom: folds, scores, and every single prediction."""
