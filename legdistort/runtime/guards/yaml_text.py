"""YAML from anywhere, looked at as a stream of events before an object is made of it."""

import yaml

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
#: Tags of plain values.
PLAIN = {f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map", "timestamp")}
_MAX_DEPTH = 100


class TooLargeError(Exception):
    """A size beyond the limit; the sentence without the limit."""


def check_yaml(text, tags, most, per=""):
    """Check nesting, repetition by aliases and tags of a text.

    Parameters
    ----------
    text : bytes or str
    tags : tuple of str
        Beginnings of the tags that may occur beside those of plain values: a tag makes a reader call a converter.
    most : int
        Nodes, with aliases written out.
    per : str, optional
        What `most` is derived from, for the message.

    Raises
    ------
    ValueError, yaml.YAMLError
        For what is no such text.
    TooLargeError
        For more nodes.
    """
    counts, anchors = [[None, 0]], {}  # open collections: anchor, number of nodes with aliases written out
    for event in yaml.parse(text, Loader=LOADER):
        if isinstance(event, yaml.events.AliasEvent):
            if event.anchor not in anchors:
                raise ValueError(f"alias *{event.anchor} of nothing, or within itself")
            counts[-1][1] += anchors[event.anchor]
        elif isinstance(event, yaml.events.CollectionEndEvent):
            anchor, number = counts.pop()
            anchors[anchor] = number
            counts[-1][1] += number
        elif isinstance(event, yaml.events.NodeEvent):
            if event.tag and event.tag not in PLAIN and not event.tag.startswith(tags):
                raise ValueError(f"tag {event.tag[:100]!r} has no business in such a file; is it the one you mean?")
            if isinstance(event, yaml.events.CollectionStartEvent):
                counts.append([event.anchor, 1])
            else:
                anchors[event.anchor] = 1
                counts[-1][1] += 1
        if len(counts) > _MAX_DEPTH:
            raise ValueError(f"its tree is nested more than {_MAX_DEPTH} levels deep")
        if counts[-1][1] > most:
            raise TooLargeError(f"its tree has more than {most} nodes{per}")
