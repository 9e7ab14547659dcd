from .blocks import SumsInBlocks as SumsInBlocks
from .blocks import TouchedSums as TouchedSums
from .blocks import added_up as added_up
from .mergeable import MergeableMetric as MergeableMetric
from .sums import MergeableSums as MergeableSums
from .sums import figure_of as figure_of
from .sums import with_rows as with_rows
