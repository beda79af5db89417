"""A page as its elements, scripts and text, to test what stands in it."""

from html.parser import HTMLParser


class Page(HTMLParser):
    """Elements with their attributes, in order; all text; and whether all elements close in order."""

    VOID = ("meta", "link", "img", "input", "br", "hr", "wbr")

    def __init__(self, text):
        super().__init__()
        self.elements, self.scripts, self.open, self.text = [], [], [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data
        if self.cdata_elem == "script":
            self.scripts[-1] += data

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"{tag} closes out of order at {self.getpos()}"

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]
