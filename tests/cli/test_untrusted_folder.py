"""Commands in a working directory with files of an attacker."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from torchcover.evaluation import study

MAIN = "import sys; sys.argv[:] = ['torchcover', *sys.argv[1:]]; from torchcover.cli.app import main; "


def run_code(folder, code, *arguments):
    """Run Python code in a folder, with the same import path."""
    program = f"import sys; sys.path[:] = {sys.path!r}; {code}"
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, check=False, cwd=folder, capture_output=True, text=True, timeout=100)


def test_local_matplotlibrc_names_no_programs(tmp_path):
    (tmp_path / "matplotlibrc").write_text("animation.ffmpeg_path: ./program.sh\n")
    print_program = "print(sys.modules['matplotlib'].rcParams['animation.ffmpeg_path'])"
    code = f"import atexit; atexit.register(lambda: {print_program}); {MAIN}main()"
    run = run_code(tmp_path, code, "show", "front_roof_32")
    assert (run.returncode, run.stdout.splitlines()[-1]) == (0, "ffmpeg")
    assert run.stderr.count("matplotlibrc: not read in the working directory") == 1


def test_local_matplotlibrc_that_is_a_pipe_is_ignored(tmp_path):
    os.mkfifo(tmp_path / "matplotlibrc")
    assert run_code(tmp_path, f"{MAIN}main()", "show", "front_roof_32").returncode == 0


def test_local_numba_config_names_no_cache(tmp_path):
    pytest.importorskip("numba")
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: cache\n")
    code = "from torchcover.recordings.free_space import get_fastest_kernel, count_votes_by_arrays as kernel; "
    run = run_code(tmp_path, f"{code}print(get_fastest_kernel(kernel) is kernel, 'numba' in sys.modules)")
    assert run.stdout == "True False\n", run.stderr


def test_timed_command_imports_nothing_from_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torchcover").mkdir()
    for name in ("__init__", "__main__"):
        (tmp_path / "torchcover" / f"{name}.py").write_text("open('executed', 'w')\n")
    with pytest.raises(ValueError, match="No such option"):
        study.measure_command_s(SimpleNamespace(command=["list"]))
    assert not (tmp_path / "executed").exists()
