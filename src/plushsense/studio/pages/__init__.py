"""One module a page: ``show(workspace)`` builds it. `plushsense.studio.app.serve.PAGES` is their table."""
