"""Docstrings, which are plain text with Sphinx roles, made fit for mkdocstrings."""

import re

import griffe

_ROLE = re.compile(r":(?:func|class|mod|meth|attr|data):`~?([\w.]+)`")
_UNIT = re.compile(r"(?<=\]) \[")  # "[-pi, pi] [rad]" is no link
_LITERAL = re.compile(r"(?<=\S)::$", re.MULTILINE)  # "so that::" before an indented block
_PUBLIC = ("jaxfilt", "jaxfilt.linalg", "jaxfilt.metrics", "jaxfilt.models", "jaxfilt.simulate", "jaxfilt.tune")


class Roles(griffe.Extension):
    """Makes links of roles, and shows the function where a module has the same name."""

    def on_package(self, *, pkg, loader, **kwargs):
        """Rewrites all docstrings, then lets ``jaxfilt.smooth`` be the function, as for Python, not its module."""
        del kwargs
        _rewrite(pkg)
        loader.resolve_aliases(implicit=True)
        for path in _PUBLIC:
            package = pkg if path == pkg.path else pkg[path.removeprefix(f"{pkg.path}.")]
            for name, member in list(package.members.items()):
                same = member.members.get(name) if member.is_module and not member.is_init_module else None
                if same is not None and not same.is_module:
                    package.members[name] = griffe.Alias(name, same, parent=package)


def _rewrite(obj):
    if obj.docstring is not None:
        text = _ROLE.sub(lambda match: _link(match.group(1), obj), obj.docstring.value)
        parts = text.split("`")
        parts[::2] = [_UNIT.sub(r" \\[", part) for part in parts[::2]]  # not within code
        obj.docstring.value = _LITERAL.sub(":", "`".join(parts))
    for member in obj.members.values():
        if not member.is_alias:
            _rewrite(member)


def _link(name, obj):
    if name.startswith("jaxfilt"):
        return f"[`{name.replace('jaxfilt', 'jf', 1)}`][{name}]"
    target = obj
    while target is not None:  # a name of the same class or module
        if (target.is_module or target.is_class) and name.split(".")[0] in target.members:
            return f"[`{name}`][{target.path}.{name}]"
        target = target.parent
    return f"`{name}`"
