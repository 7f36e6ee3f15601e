"""`index.html` of a model: results, scores, warnings, figures, files.

The page is read from disk or from the service; it has no scripts and loads only images of its
folder.
"""

from stage_service.model_page.page import model_page, write_page

__all__ = ["model_page", "write_page"]
