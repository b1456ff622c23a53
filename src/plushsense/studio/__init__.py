"""The studio: the whole work in a browser, on one's own machine. `plushsense.studio.app.serve` runs it."""
