"""A process that is killed at any of its file operations."""

import itertools
import os
import shutil
import signal
import sys
import threading

# A fork may wait without end for a thread that only its parent has.
LONGEST_S = 300
# Two at once are more than what locks files can bear.
FORKING = threading.Lock()
# Of Python's audit events.
OPERATIONS = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate")


def operations_of(act, at=None, number=signal.SIGKILL, *, copied=None):
    """Do something in a fork of this process, and send it a signal just before a file operation.

    Args:
        act: What to do; its operations have to be the same each time.
        at: Before which operation; None for none.
        number: The signal.
        copied: A folder, and where it is copied to just before every operation, each time under its number: what a
            kill there leaves, which lets nobody go on and takes nothing back.

    Returns:
        How many operations there were, and the exit code, minus the signal's number if that has ended it.
    """
    there, here = os.pipe()
    with FORKING:
        pid = os.fork()
    if pid:
        os.close(here)
        with open(there, "rb") as told:
            count = len(told.read())
        return count, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    counting, killed_pid = itertools.count(), os.getpid()
    is_copying = False

    def touched(event, arguments):
        nonlocal is_copying
        if os.getpid() != killed_pid:  # a child of it
            return
        # Where a file is opened for reading nothing can break.
        if event in OPERATIONS and (event != "open" or arguments[1] not in ("r", "rb")) and not is_copying:
            index = next(counting)
            if index == at:
                os.kill(os.getpid(), number)
            is_copying = True
            if copied and os.path.isdir(copied[0]):
                shutil.copytree(copied[0], os.path.join(copied[1], str(index)), symlinks=True)
            is_copying = False
            os.write(here, b".")

    code = 1
    signal.alarm(LONGEST_S)
    try:
        sys.addaudithook(touched)
        act()
        code = 0
    finally:
        os._exit(code)
