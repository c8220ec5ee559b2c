"""Pages that the program writes: their elements and text, and where they lead."""

import re
from html.parser import HTMLParser

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&"


class Page(HTMLParser):
    """The elements of a page with their attributes, and its text without scripts and styles."""

    def __init__(self, source):
        super().__init__()
        self.elements, self.text, self._raw = [], "", False
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._raw = tag in ("script", "style")

    def handle_endtag(self, tag):
        self._raw = False

    def handle_data(self, data):
        self.text += "" if self._raw else " ".join(data.split()) + " "

    def with_attribute(self, name):
        return [attributes for _, attributes in self.elements if name in attributes]


def judge_targets(source):
    """Nothing that a page shows or leads to lies on another machine."""
    targets = [element[name] for name in ("src", "href", "action") for element in Page(source).with_attribute(name)]
    assert not [target for target in targets if re.match(r"\s*(?:https?:)?//", target)]
    assert "default-src 'none'" in source and "@import" not in source
    # plotly.js offers to upload a chart to its makers' server unless it is told not to.
    assert "showSendToCloud: false" in source
