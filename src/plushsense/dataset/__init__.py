"""What was recorded: the folder, the importers, the checks at the door."""
