"""The studio, a web application for the whole workflow; `plushsense.studio.app.serve` runs it."""
