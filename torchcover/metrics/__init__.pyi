from .blocked_sums import BlockedSums as BlockedSums
from .blocked_sums import SparseSums as SparseSums
from .blocked_sums import sum_rows as sum_rows
from .mergeable import MergeableMetric as MergeableMetric
from .sums import MergeableSums as MergeableSums
from .sums import get_figure as get_figure
from .sums import insert_rows as insert_rows
