"""Changes to an XML file that leave all other bytes as they are."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from frictionzoo.core.xml import write_comment, write_element

_START = re.compile(rb"<(?:\"[^\"]*\"|'[^']*'|[^>\"'])*>")
_ATTRIBUTE = re.compile(rb"\s([^\s=<>\"'/]+)\s*=\s*(\"[^\"]*\"|'[^']*')")
_LAST_LINE = re.compile(rb"\r?\n[ \t]*\Z")


@dataclass
class Tag:
    """An element of a file and its position.

    Attributes:
        path: Names of the enclosing elements, the root first.
        owner: The enclosing element; None for the root.
        start: Byte index of the element's beginning.
        opened: Byte index after its start tag.
        closing: Byte index of its end tag; `opened` without an end tag.
    """

    name: str
    attributes: dict[str, str]
    path: tuple[str, ...]
    owner: "Tag | None"
    start: int
    opened: int
    closing: int = -1


@dataclass
class InPlace:
    """A file, its elements in order, and its changes: first byte, byte after the last one, replacement."""

    content: bytes
    tags: list[Tag]
    changes: list[tuple[int, int, bytes]] = field(default_factory=list)

    @classmethod
    def read(cls, content: bytes) -> "InPlace":
        """Find the elements of a file.

        Raises:
            expat.ExpatError: The content is not XML.
        """
        parser, tags, enclosing = expat.ParserCreate(), list[Tag](), list[Tag]()

        def begin(name: str, attributes: dict[str, str]) -> None:
            start = parser.CurrentByteIndex
            start_tag = _START.match(content, start)
            opened = start_tag.end() if start_tag else start
            path = tuple(tag.name for tag in enclosing)
            tags.append(Tag(name, attributes, path, enclosing[-1] if enclosing else None, start, opened))
            enclosing.append(tags[-1])

        def end(name: str) -> None:
            tag = enclosing.pop()
            tag.closing = max(tag.opened, parser.CurrentByteIndex)

        parser.StartElementHandler, parser.EndElementHandler = begin, end
        parser.Parse(content, True)
        return cls(content, tags)

    def set(self, tag: Tag, attributes: Mapping[str, str]) -> None:
        """Set these attributes of an element; its other attributes stay."""
        text = self.content[tag.start : tag.opened]
        for name, value in attributes.items():
            addition = _encode(f" {name}={quoteattr(value)}")
            # Match attribute by attribute: the value of another attribute may contain similar text.
            old = next((candidate for candidate in _ATTRIBUTE.finditer(text) if candidate[1] == name.encode()), None)
            if old:
                text = text[: old.start(2)] + _encode(quoteattr(value)) + text[old.end(2) :]
            else:
                end = re.search(rb"\s*/?>\Z", text)
                assert end is not None
                text = text[: end.start()] + addition + text[end.start() :]
        self.changes.append((tag.start, tag.opened, text))

    def replace(self, tag: Tag, element: "ET.Element[Any]") -> None:
        """Replace an element and its content by another element."""
        self.changes.append((tag.start, self._end(tag), _write(element)))

    def remove(self, tag: Tag) -> None:
        """Remove an element and its content, and the line if it becomes empty."""
        end = self._end(tag)
        line = _LAST_LINE.search(self.content[: tag.start])
        alone = line and re.match(rb"[ \t]*\r?\n", self.content[end:])
        self.changes.append((line.start() if line and alone else tag.start, end, b""))

    def _end(self, tag: Tag) -> int:
        if tag.closing > tag.opened or not self.content[: tag.opened].endswith(b"/>"):
            return self.content.index(b">", tag.closing) + 1
        return tag.opened

    def append(self, tag: Tag, element: "ET.Element[Any]") -> None:
        """Append an element to another one, on a separate line if the end tag has one."""
        if self.content[: tag.opened].endswith(b"/>"):
            content = b">" + _write(element) + _encode(f"</{tag.name}>")
            self.changes.append((tag.opened - 2, tag.opened, content))
            return
        lead = _LAST_LINE.search(self.content[tag.opened : tag.closing])
        position = tag.closing - len(lead[0]) if lead else tag.closing
        self.changes.append((position, position, (lead[0] + b"  " if lead else b"") + _write(element)))

    def remark(self, text: str) -> None:
        """Insert a comment at the beginning of the root, on a separate line if the following content has one."""
        root = self.tags[0]
        lead = re.match(rb"(\r?\n)[ \t]*(?:\r?\n[ \t]*)*", self.content[root.opened :])
        indent = lead[1] + lead[0].rpartition(b"\n")[2] if lead else b""
        self.changes.append((root.opened, root.opened, indent + _write(write_comment(text))))

    def write(self) -> bytes:
        """Return the content with all changes."""
        parts, done = list[bytes](), 0
        for start, end, text in sorted(self.changes, key=lambda change: change[:2]):
            parts += [self.content[done:start], text]
            done = end
        return b"".join([*parts, self.content[done:]])


def _write(element: "ET.Element[Any]") -> bytes:
    return _encode(write_element(element).replace(" />", "/>"))


def _encode(text: str) -> bytes:
    """Encode as ASCII, valid in most encodings; other characters become references, in comments question marks."""
    return text.encode("ascii", "replace" if text.startswith("<!--") else "xmlcharrefreplace")
