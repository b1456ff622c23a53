"""Long work that the studio does in a process of its own: ``run(spec, tell) -> result``. See `..worker.TASKS`."""
