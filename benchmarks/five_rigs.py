"""Five rigs beside each other in the same frames, over one rig: the reference is cast once."""

from benchmarks.timing import compare, table
from benchmarks.urban_throughput import new_metric
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import PaperReference

RIGS = ("front_roof_128", "front_grille_128", "front_roof_64", "front_roof_32", "three_cameras")
STEPS = 3


def main():
    """Print the ratio in `urban` for two numbers of reference rays, all in this process."""
    rows = []
    for side in (256, 1024):
        runs = [evaluation((rig,), side) for rig in RIGS] + [evaluation(RIGS, side)]
        seconds, _ = compare(*runs, rounds=3)
        *alone, together = (each / STEPS for each in seconds)
        rows.append((f"{side} x {side}", *alone, together, together / alone[0], together / sum(alone)))
    table(("reference rays", *(f"{rig} (s)" for rig in RIGS), "all five (s)", "over the first", "over the sum"), rows)


def evaluation(rigs, side):
    """A function that makes some frames of these rigs and adds them to their metrics."""
    reference = PaperReference(rows=side, columns=side)
    frames = SimulatedFrames("urban", rigs={rig: rig for rig in rigs}, steps=STEPS, seed=0, reference_sensor=reference)
    observers = [CoverageObserver(new_metric(), rig) for rig in rigs]
    return lambda: observe(frames, observers)


if __name__ == "__main__":
    main()
