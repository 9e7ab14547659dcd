from .boxes import Boxes as Boxes
from .inside import find_points_in_boxes as find_points_in_boxes
from .matching import compute_bev_iou as compute_bev_iou
from .matching import match_detections as match_detections
from .recall import RecallByVisibility as RecallByVisibility
from .recall_curve import DetectionCounts as DetectionCounts
from .visibility import BoxVisibility as BoxVisibility
from .visibility import measure_box_visibility as measure_box_visibility
