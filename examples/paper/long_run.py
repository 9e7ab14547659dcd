import sys, time
from pathlib import Path
import torch
from torchcover import BevGrid, CoverageMetric, forward_regions, Region
from torchcover.data import SimulatedFrames
from torchcover.simulation import PaperReference, SurfaceReference
from examples.paper.pieces import save_piece
from examples.paper.thinning import thinned
torch.set_num_threads(1)
MOUNTINGS = ("grille_128", "roof_128", "roof_64", "roof_32")
def passes(seed, steps, every):
    for name, patterns, reach, x0 in (("a", ("front_{}", "paper_fit_{}"), 250.0, 0.0), ("b", ("paper_fit_b_{}",), 120.0, -1.4)):
        rigs = [p.format(m) for p in patterns for m in MOUNTINGS]
        grid = BevGrid(x=(x0, x0+160.0), y=(-40.0, 40.0), cell=0.25)
        coarse = BevGrid(x=grid.x, y=grid.y, cell=1.0)
        areas = tuple(((x0, x0+r), (-r/4, r/4)) for r in (20.0, 80.0, 160.0))
        paper = SimulatedFrames("urban", rigs={r: r for r in rigs}, steps=steps, seed=seed, every_s=every, reference_sensor=PaperReference(max_range_m=reach))
        surface = paper.with_reference_sensor(SurfaceReference(areas, max_range_m=reach))
        yield name, rigs, grid, coarse, paper, surface
def piece(rigs, grid, coarse, paper, surface, indices):
    known = {r: CoverageMetric(grid, max_radius=grid.diagonal_m) for r in rigs}
    area = {r: CoverageMetric(coarse, max_radius=coarse.diagonal_m, square_metres=True) for r in rigs}
    for i in indices:
        f = paper[i]
        reference = thinned(f.reference, grid, 16, i)
        for r in rigs:
            known[r].update(f.clouds[r], reference, index=i)
        s = surface[i]
        for r in rigs:
            area[r].update(s.clouds[r], s.reference, weights=s.reference_weights, index=i)
    return {(r, m): metrics[r].compute() for m, metrics in (("known", known), ("area", area)) for r in rigs}
def main(out, seed, steps, length, every):
    every_pass = list(passes(seed, steps, every))
    for first in range(0, steps, length):
        for name, *rest in every_pass:
            folder = Path(out) / name / f"{first:05d}"
            if folder.exists():
                continue
            t = time.time()
            save_piece(folder, piece(*rest, range(first, first+length)))
            print(time.strftime("%H:%M:%S"), folder, f"{time.time()-t:.0f} s", flush=True)
if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5]))
