"""One module an experiment: ``Options``, and ``run``, which yields reports."""
