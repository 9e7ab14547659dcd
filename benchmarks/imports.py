"""What importing costs, and how soon the command line answers."""

import subprocess
import sys
from pathlib import Path

from benchmarks.timing import compare, table


def main():
    """Print the times."""

    def python(program):
        return lambda: subprocess.run([sys.executable, "-c", program], check=True)

    command = Path(sys.executable).parent / "torchcover"
    seconds, _ = compare(
        python("import torch"),
        python("import torch, torchcover"),
        lambda: subprocess.run([command, "--help"], check=True, capture_output=True),
    )
    table(
        ("", "seconds"),
        [
            ("import torch", seconds[0]),
            ("import torch, torchcover", seconds[1]),
            ("torchcover --help", seconds[2]),
        ],
    )


if __name__ == "__main__":
    main()
