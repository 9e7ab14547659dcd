"""Brute-force search in tiles: any device, any size, within a memory budget.

Matrix multiplication is the fastest way to many squared distances, ||q||^2 - 2 q.p + ||p||^2, and loses the small
ones to cancellation (pytorch issues 42479 and 57690). Here it only screens: it rules out whole blocks of points that,
by a bound on its rounding error, cannot hold the nearest one. What is left is compared by coordinate differences.
"""

import torch
from torch import Tensor

BLOCK = 256  # points that are ruled out together
TILE = 1 << 20  # pairs in one product: small enough for the cache, where the screening spends its time

# Comparing a block that remains costs this many times its share in one comparison of everything with everything.
FULL_COMPARISON_PAYS = 6


def search(query: Tensor, points: Tensor, max_distance: float, memory_mb: float) -> Tensor:
    """Index of a nearest point for each query.

    Args:
        query: (N, 3) finite coordinates.
        points: (M, 3) finite coordinates, M > 0, of the same type and device.
        max_distance: Queries without a point in reach may return any index.
        memory_mb: Most memory in megabytes for the pairs under comparison, beside a few arrays as long as the clouds.

    Returns:
        (N,) int64 indices into `points`.
    """
    budget = int(memory_mb * 1e6) // query.element_size()
    # Fewer points than a block are compared faster than screened: a block is filled up.
    if len(points) >= BLOCK and _matrix_product_is_exact_enough(query) and budget >= 4 * TILE:
        return _search_by_screening(query, points, budget)
    return _search_by_differences(query, points, budget)


def _matrix_product_is_exact_enough(query: Tensor) -> bool:
    # On other devices, or where the user allows TF32 or bfloat16 products, the error bound below does not hold.
    if query.device.type != "cpu":
        return False
    try:
        return torch.get_float32_matmul_precision() == "highest"
    except RuntimeError:  # it was lowered through torch.backends...fp32_precision, of which this function knows nothing
        return False


def _search_by_differences(query: Tensor, points: Tensor, budget: int) -> Tensor:
    """torch.cdist without matrix products, in chunks; keeps the running minimum."""
    columns = max(1, min(len(points), budget // 2))
    rows = max(1, budget // 2 // columns)
    return torch.cat([_nearest_in_chunks(chunk, points, columns) for chunk in torch.split(query, rows)])


def _nearest_in_chunks(query: Tensor, points: Tensor, columns: int) -> Tensor:
    best = torch.full_like(query[:, 0], torch.inf)
    index = torch.zeros(len(query), dtype=torch.int64, device=query.device)
    for start in range(0, len(points), columns):
        distance, at = torch.cdist(
            query, points[start : start + columns], compute_mode="donot_use_mm_for_euclid_dist"
        ).min(dim=1)
        closer = distance < best
        best, index = best.where(~closer, distance), index.where(~closer, at + start)
    return index


def _search_by_screening(query: Tensor, points: Tensor, budget: int) -> Tensor:
    # Centred clouds have shorter vectors, and the bound grows with their length squared. Centring rounds, so it is
    # for the screening only: the comparison by differences takes the coordinates as they came.
    centre = points.mean(dim=0)
    blocks = _to_blocks(points)
    centred = blocks - centre
    # Five arrays of (rows, blocks) live at once: the minima, two bounds, their sum, the mask.
    rows = max(1, budget // 2 // (5 * len(blocks)))
    found = [_search_rows(chunk, chunk - centre, blocks, centred, budget // 2) for chunk in torch.split(query, rows)]
    # The last block is filled up with copies of the last point.
    return torch.cat(found).clamp(max=len(points) - 1)


def _to_blocks(points: Tensor) -> Tensor:
    """(M, 3) to (B, BLOCK, 3), the last block filled up with copies of the last point."""
    missing = -len(points) % BLOCK
    return torch.cat([points, points[-1:].expand(missing, 3)]).view(-1, BLOCK, 3)


def _search_rows(query: Tensor, centred_query: Tensor, blocks: Tensor, centred_blocks: Tensor, budget: int) -> Tensor:
    least, error = _least_squared_distance_per_block(centred_query, centred_blocks)
    # The nearest point is no farther than any block's minimum could be, and no block is closer than its own could be.
    upper = (least + error).amin(dim=1, keepdim=True)
    row, block = (least - error <= upper).nonzero(as_tuple=True)
    if len(row) * FULL_COMPARISON_PAYS > least.numel():
        columns = max(1, min(blocks.shape[0] * BLOCK, budget // (2 * len(query))))
        return _nearest_in_chunks(query, blocks.view(-1, 3), columns)
    return _compare_by_differences(query, blocks, row, block, budget)


def _least_squared_distance_per_block(query: Tensor, blocks: Tensor) -> tuple[Tensor, Tensor]:
    """(N, B) approximate minimum over each block of ||p||^2 - 2 q.p, and a bound on its error."""
    points = blocks.view(-1, 3)
    squared = points.square().sum(dim=1)
    minus_two_points = (-2 * points).T.contiguous()
    least = query.new_empty(len(query), len(blocks))
    per_tile = 32  # blocks in a product
    rows = TILE // (per_tile * BLOCK)
    for top in range(0, len(query), rows):
        for left in range(0, len(blocks), per_tile):
            columns = slice(left * BLOCK, (left + per_tile) * BLOCK)
            product = torch.addmm(squared[columns], query[top : top + rows], minus_two_points[:, columns])
            torch.amin(
                product.view(len(product), -1, BLOCK),
                dim=2,
                out=least[top : top + rows, left : left + per_tile],
            )
    # Products and sums of three terms, and the centring, each cost a few roundings of numbers that are at most
    # (||q|| + ||p||)^2; 16 is above their total.
    reach = query.norm(dim=1, keepdim=True) + blocks.norm(dim=2).amax(dim=1)
    return least, reach.square().mul_(16 * torch.finfo(query.dtype).eps)


def _compare_by_differences(query: Tensor, blocks: Tensor, row: Tensor, block: Tensor, budget: int) -> Tensor:
    """The index of the nearest point among the blocks that remain, one (row, block) pair at a time."""
    squared = query.new_empty(len(row))
    index = torch.empty_like(row)
    # Two arrays of (pairs, BLOCK, 3) live at once, and one of a third of that size.
    for pairs in torch.split(torch.arange(len(row), device=row.device), max(1, budget // (7 * BLOCK))):
        difference = blocks[block[pairs]] - query[row[pairs], None]
        least, at = difference.square_().sum(dim=2).min(dim=1)
        squared[pairs], index[pairs] = least, block[pairs] * BLOCK + at
    return _first_least_per_row(len(query), row, squared, index)


def _first_least_per_row(rows: int, row: Tensor, squared: Tensor, index: Tensor) -> Tensor:
    best = squared.new_full((rows,), torch.inf).scatter_reduce(0, row, squared, "amin")
    is_best = squared == best[row]
    first = torch.full((rows,), torch.iinfo(torch.int64).max, device=row.device)
    return first.scatter_reduce(0, row[is_best], index[is_best], "amin")
