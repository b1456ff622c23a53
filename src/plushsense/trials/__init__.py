"""Trials of a grid of networks: the grid, the plan of trainings, their scores and tables."""
