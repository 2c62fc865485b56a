"""What a notebook shows of our objects: what `print` shows."""

from html import escape


class ShownAsPrinted:
    """An object whose cell in a notebook holds what `print` shows of it."""

    def _repr_html_(self):
        return f'<pre style="line-height: 1.3">{escape(str(self))}</pre>'
