"""The command ``legdistort`` and scripts of Python, in forks of a process that has imported everything.

Of most commands the start, with its imports and the extensions of ASDF, takes longer than the work. On ``PATH`` stands
a command ``legdistort`` that only says what is asked, where, and with which input and output; a fork does it, as
`legdistort.cli.main` would in a process of its own.

    python tests/warm_process.py FOLDER

serves in a folder until it is ended. For systems with ``fork`` only.
"""

import atexit
import contextlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import traceback
from pathlib import Path

HERE = Path(__file__).parent
#: Runs without the site packages, in 20 ms; prints nothing of its own.
CLIENT = """#!{python} -IS
import json, os, socket, sys
request = json.dumps([sys.argv, os.getcwd(), dict(os.environ)]).encode()
os.chdir({folder!r})
with socket.socket(socket.AF_UNIX) as place:
    place.connect("place")
    socket.send_fds(place, [len(request).to_bytes(4, "big")], [0, 1, 2])
    place.sendall(request)
    status = place.recv(1)
sys.exit(status[0] if status else "the command ended without a status")
"""


@contextlib.contextmanager
def served(folder):
    """Serve in an empty folder; gives the folder of the commands ``legdistort`` and ``legdistort-python FILE``."""
    commands = folder / "bin"
    commands.mkdir()
    for name in ("legdistort", "legdistort-python"):
        (commands / name).write_text(CLIENT.format(python=sys.executable, folder=str(folder)), encoding="utf-8")
        (commands / name).chmod(0o755)
    server = subprocess.Popen([sys.executable, __file__, folder], stdout=subprocess.PIPE)
    try:
        assert server.stdout.readline() == b"ready\n"
        yield commands
    finally:
        server.terminate()
        server.wait()
        server.stdout.close()


def warm():
    """Import all, and what is loaded at the first use of a file; returns what ``import legdistort`` alone gives."""
    import legdistort

    fresh = set(vars(legdistort))
    import asdf
    import matplotlib.pyplot
    import numba  # noqa: F401

    from legdistort import pipeline  # noqa: F401
    from legdistort.cli import commands  # noqa: F401

    for name in legdistort.__all__:
        getattr(legdistort, name)
    asdf.AsdfFile().close()
    matplotlib.pyplot.close(matplotlib.pyplot.figure())
    assert threading.active_count() == 1  # a fork has no other
    return fresh


def serve(folder, fresh):
    """One fork for every command."""
    os.chdir(folder)
    signal.signal(signal.SIGCHLD, lambda *_: reap())
    with socket.socket(socket.AF_UNIX) as place:
        place.bind("place")
        place.listen()
        print("ready", flush=True)
        while True:
            asked, _ = place.accept()
            if os.fork() == 0:
                place.close()
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                answer(asked, fresh)
            asked.close()


def reap():
    """Forget the forks that have ended."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def answer(asked, fresh):
    """Do it, and end."""
    size, files, *_ = socket.recv_fds(asked, 4, 3)
    content = b""
    while len(content) < int.from_bytes(size, "big"):
        content += asked.recv(1 << 16)
    (command, *arguments), folder, environment = json.loads(content)
    for i, file in enumerate(files):
        os.dup2(file, i)
        os.close(file)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    status = 1
    try:
        status = work(Path(command).name, arguments, fresh)
    except SystemExit as end:
        status = end.code
    except BaseException:
        traceback.print_exc()
    if not isinstance(status, (int, type(None))):
        print(status, file=sys.stderr)
        status = 1
    atexit._run_exitfuncs()
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    asked.sendall(bytes([status or 0]))
    os._exit(0)


def work(command, arguments, fresh):
    """Exit status of a command; that of a script is 0, if it comes to its end.

    A script finds in ``legdistort`` what it would find after its own import: no module that others have loaded.
    """
    import legdistort

    for name in set(vars(legdistort)) - fresh:
        delattr(legdistort, name)
    if command == "legdistort":
        from legdistort.cli import main

        sys.argv = [command, *arguments]
        return main()
    sys.argv = arguments
    runpy.run_path(arguments[0], run_name="__main__")
    return 0


if __name__ == "__main__":
    serve(sys.argv[1], warm())
