"""A long run in pieces: each is written when it is complete, and pieces merge into one coverage.

A piece is a folder with two coverage files for each rig: `RIG_known.npz` from the paper's rays, and `RIG_area.npz` from
points on the surface. It is a block of contiguous steps, from which standard errors follow.
"""




def save_piece(folder, coverages):
    """Write a piece; a folder that has its name is complete."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = folder.with_name(f"{folder.name}.part")
    unfinished.mkdir(exist_ok=True)
    for (rig, measure), coverage in coverages.items():
        coverage.save(unfinished / f"{rig}_{measure}.npz")
    unfinished.rename(folder)
