"""Run many independent jobs, several at a time, and store each result as soon as it is done."""
