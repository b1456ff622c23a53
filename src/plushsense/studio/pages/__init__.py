"""Pages of the studio: each is a folder with a module ``page`` and is listed in `plushsense.studio.app.shell.PAGES`."""
