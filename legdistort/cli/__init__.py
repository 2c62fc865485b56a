"""The command ``legdistort``."""

from .process import beginning

__all__ = ["command", "main"]


def main(argv=None):
    """Run a command line in this process; returns the exit status, see `legdistort.cli.parser.main`."""
    from .parser import main as run

    return run(argv)


def command():
    """What the shell calls: `main` in a process of its own, where garbage is sought less often, and not at the end.

    What a run loads and makes are millions of objects that stay. Looking through them takes a tenth of its time and
    finds next to nothing, since arrays are freed without a search.
    """
    with beginning():
        import gc

        first, *others = gc.get_threshold()
        gc.set_threshold(10 * first, *others)
        try:
            return main()
        finally:
            gc.freeze()
