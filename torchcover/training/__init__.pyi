from .counting import CountOnce as CountOnce
from .counting import shard_of as shard_of
from .figures import log_maps as log_maps
from .lightning import CoverageCallback as CoverageCallback
from .mmdetection3d import frames_of_data_batch as frames_of_data_batch
from .mmengine import MMEngineCoverage as MMEngineCoverage
from .mmengine import PackWithReference as PackWithReference
from .openpcdet import frames_of_batch_dict as frames_of_batch_dict
