"""The pages: each is a folder with a module ``page``. `plushsense.studio.app.shell.PAGES` is the registry."""
