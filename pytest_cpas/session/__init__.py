"""pytest runs with ``--cpas-*``: what is asked for, what comes back, how it is judged."""
