from .frame_metric import FrameMetric as FrameMetric
from .number import PublishedNumber as PublishedNumber
from .registry import PUBLISHED as PUBLISHED
from .setup import Published as Published
from .setup import Setup as Setup
from .sights import Sights as Sights
from .world_ratios import Ratio as Ratio
from .world_ratios import WorldRatios as WorldRatios
