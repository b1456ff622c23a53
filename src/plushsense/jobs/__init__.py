"""Many jobs, whatever they are: each one kept the moment it is done, several at once."""
