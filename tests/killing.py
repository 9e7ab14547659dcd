"""Processes that are killed before one of their file operations."""

import itertools
import os
import shutil
import signal
import sys
import threading

MAX_DURATION_S = 300  # a fork may wait forever for a thread that only its parent has
FORK_LOCK = threading.Lock()  # more than two forks at once are too many for file locks
FILE_OPERATIONS = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate")  # audit events of Python


def run_in_fork(act, at=None, signal_number=signal.SIGKILL, *, copied=None):
    """Run a function in a fork of this process, and send the fork a signal before a file operation.

    Args:
        act: Function with the same file operations in every call.
        at: Index of the operation before which the signal is sent; None for no signal.
        signal_number: The signal.
        copied: A folder, and the folder for copies of it, one before each operation, named by its index. A copy is
            what a kill at that operation leaves.

    Returns:
        Number of operations, and the exit code, which is minus the number of a signal that ended the fork.
    """
    read_end, write_end = os.pipe()
    with FORK_LOCK:
        pid = os.fork()
    if pid:
        os.close(write_end)
        with open(read_end, "rb") as pipe:
            operation_count = len(pipe.read())
        return operation_count, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    counter, fork_pid = itertools.count(), os.getpid()
    is_copying = False

    def handle_event(event, arguments):
        nonlocal is_copying
        if os.getpid() != fork_pid:  # a child of the fork
            return
        # Opening a file for reading changes nothing.
        is_reading = event == "open" and arguments[1] in ("r", "rb")
        if event in FILE_OPERATIONS and not is_reading and not is_copying:
            index = next(counter)
            if index == at:
                os.kill(os.getpid(), signal_number)
            is_copying = True
            if copied and os.path.isdir(copied[0]):
                shutil.copytree(copied[0], os.path.join(copied[1], str(index)), symlinks=True)
            is_copying = False
            os.write(write_end, b".")

    code = 1
    signal.alarm(MAX_DURATION_S)
    try:
        sys.addaudithook(handle_event)
        act()
        code = 0
    finally:
        os._exit(code)
