"""Which channels and moments decided: occlusion of a network's inputs, checked by deletion."""
