"""Where training and evaluation meet: the Python face, the configuration, the command line, the demo."""
