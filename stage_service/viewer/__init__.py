"""The viewer: strands that turn under the hand in a browser, and light that is dragged.

What the page is told lies here; `api/viewing.py` has the routes, `page/` what the browser runs.
"""

from stage_service.viewer.viewed import BadLight as BadLight
from stage_service.viewer.viewed import NothingToView as NothingToView
from stage_service.viewer.viewed import Viewed as Viewed
from stage_service.viewer.viewing import Viewing as Viewing
