"""Formulas as MathML, which browsers show by themselves: no script, nothing fetched."""

import html
import re

from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_page_content(page: str, /, **_: object) -> str:
    """Replace the formulas in the HTML of a page; MkDocs calls this."""
    page = INLINE.sub(lambda found: convert(html.unescape(found[1])), page)
    return BLOCK.sub(lambda found: convert(html.unescape(found[1]), display="block"), page)
