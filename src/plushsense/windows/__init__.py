"""From recorded frames to windows: the clock rule, derived channels and scaling, the cut."""
