"""One module a page: ``show(house)`` builds it. `plushsense.apps.studio.serve.PAGES` is their table."""
