"""The studio: the whole work in a browser, on one's own machine. `plushsense.apps.studio.serve` runs it."""
