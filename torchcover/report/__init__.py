"""What a run shows: tables, summaries and maps of a `Coverage`. Imports matplotlib and rich, so import it late."""

from torchcover.report.comparison import draw_comparison, draw_side_by_side
from torchcover.report.comparison_table import comparison_dict, comparison_tables, narrowest_width, write_comparison
from torchcover.report.maps import draw_map, draw_maps
from torchcover.report.overlay import SensorMark
from torchcover.report.rig_view import SensorView, draw_rig
from torchcover.report.scale import ColourScale, detection_scale, difference_scale, radius_scale
from torchcover.report.scene_view import ActorMark, draw_scene
from torchcover.report.table import coverage_table, summary_dict, write_csv

__all__ = [
    "ActorMark",
    "ColourScale",
    "SensorMark",
    "SensorView",
    "comparison_dict",
    "comparison_tables",
    "coverage_table",
    "detection_scale",
    "difference_scale",
    "draw_comparison",
    "draw_map",
    "draw_maps",
    "draw_rig",
    "draw_scene",
    "draw_side_by_side",
    "narrowest_width",
    "radius_scale",
    "summary_dict",
    "write_comparison",
    "write_csv",
]
