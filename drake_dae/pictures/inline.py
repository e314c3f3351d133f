"""HTML pages that a notebook displays."""

import html


class InlinePage(str):
    """An HTML page as text; a notebook displays it in a frame."""

    def _repr_html_(self) -> str:
        page = html.escape(str(self), quote=True)
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 600px; border: 0"></iframe>'
