from .boxes import Boxes as Boxes
from .inside import points_in_boxes as points_in_boxes
from .matching import bev_iou as bev_iou
from .matching import match as match
from .recall import RecallByVisibility as RecallByVisibility
from .recall_curve import DetectionCounts as DetectionCounts
from .visibility import BoxVisibility as BoxVisibility
from .visibility import box_visibility as box_visibility
