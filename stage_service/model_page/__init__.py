"""`index.html` of a model: what is there, which of it is the result, how good, what was left out.

The page is read from disk or from the service: it runs no script and asks for nothing but the
pictures beside it.
"""

from stage_service.model_page.page import model_page, write_page

__all__ = ["model_page", "write_page"]
