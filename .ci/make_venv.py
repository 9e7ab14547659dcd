"""Make a virtual environment with pip in it, on machines that lack the `venv` extras too.

Debian and Ubuntu ship Python without `ensurepip`, so that `python3 -m venv` fails until `python3-venv` is installed.
Usage: python3 make_venv.py FOLDER
"""

import importlib.util
import os
import shutil
import subprocess
import sys
import venv

MIN_PYTHON = (3, 11)


def main(folder: str) -> None:
    if sys.version_info < MIN_PYTHON:
        sys.exit(
            f"torchcover needs Python >= {MIN_PYTHON[0]}.{MIN_PYTHON[1]}; {sys.executable} is {sys.version.split()[0]}."
            " Name another interpreter, for example: make PYTHON=python3.12 test"
        )
    if importlib.util.find_spec("ensurepip"):
        venv.create(folder, with_pip=True, clear=True)
    elif shutil.which("uv"):
        subprocess.run(["uv", "venv", "--seed", "--clear", "--python", sys.executable, folder], check=True)
    elif importlib.util.find_spec("virtualenv"):
        subprocess.run([sys.executable, "-m", "virtualenv", "--clear", folder], check=True)
    else:
        install_debian_venv()
        # A new process: this one has already looked for ensurepip and remembers that it is missing.
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)


def install_debian_venv() -> None:
    package = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
    as_root = [] if os.geteuid() == 0 else ["sudo", "-n"]
    can = shutil.which("apt-get") and (not as_root or shutil.which("sudo"))
    print(f"This Python has no ensurepip; installing {package} with apt-get.", flush=True)
    if can:
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        subprocess.run([*as_root, "apt-get", "update", "-qq"], env=environment, check=False)
        done = subprocess.run([*as_root, "apt-get", "install", "-y", "-qq", package], env=environment, check=False)
        if done.returncode == 0:
            return
    sys.exit(f"Could not install {package} here. Run this once, then make again:\n  sudo apt-get install {package}")


if __name__ == "__main__":
    main(sys.argv[1])
