"""XML output in which any name stays an attribute, a text or a comment."""

import re
import xml.etree.ElementTree as ET
from typing import Any

from frictionzoo.core.errors import ExportError
from frictionzoo.core.telling import escape_controls

_IMPOSSIBLE = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_xml(root: "ET.Element[Any]") -> str:
    """Write a whole file, indented.

    Raises:
        ExportError: A name or a text has a character that XML cannot represent, not even as a reference.
    """
    ET.indent(root)
    return write_element(root) + "\n"


def write_element(element: "ET.Element[Any]") -> str:
    """Write an element on one line; ExportError as for `write_xml`."""
    for part in element.iter():
        for text in (*part.attrib.values(), part.text or ""):
            if match := _IMPOSSIBLE.search(text):
                raise ExportError(
                    f"{text!r}: the character {match[0]!r} in it cannot be written, expected one that XML has; rename "
                    "it in the model"
                )
    return ET.tostring(element, encoding="unicode")


def write_comment(text: str) -> "ET.Element[Any]":
    """Write a one-line comment that the text cannot end early; control characters are escaped."""
    return ET.Comment(f" {re.sub('-(?=-)', '- ', escape_controls(text))} ")
