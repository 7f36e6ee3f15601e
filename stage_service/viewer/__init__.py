"""The viewer: strands of a model in a browser, relit interactively.

`api/viewing.py` has the routes, `page/` the browser's code.
"""

from stage_service.viewer.errors import BadLight as BadLight
from stage_service.viewer.errors import NothingToView as NothingToView
from stage_service.viewer.operations import Source as Source
from stage_service.viewer.tracer import Tracer as Tracer
from stage_service.viewer.tracer import TracerStopped as TracerStopped
from stage_service.viewer.viewed import Viewed as Viewed
from stage_service.viewer.viewing import RemoteViewing as RemoteViewing
from stage_service.viewer.viewing import Viewing as Viewing
