from .calibration import Calibration as Calibration
from .calibration import convert_carla_pose as convert_carla_pose
from .camera import Camera as Camera
from .depth import decode_carla as decode_carla
from .depth import read_depth as read_depth
