"""Train and compare the networks of a grid: the grid itself, the plan of trainings, their scores and tables."""
