"""The ledger of the repository: lines, words, circles of imports, old vocabulary, parts.

`make ledger` prints it for the working tree; `--before COMMIT` adds the figures of a commit beside
them, `--parts` the table of parts, `--words` every entry of the old vocabulary with its place.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import subprocess
import sys
import tarfile
import tempfile
import tokenize
import tomllib
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("reconstruction", "appearance", "stage_service", "simulators")
GENERATED = "<!-- generated"
"""A page that begins with this is written by a command and not counted as written by hand."""
LONG = 400
"""Lines beyond which a file is listed."""
ENTRIES = (
    *("stage_service.cli", "stage_service.api", "stage_service.jobs", "stage_service.web"),
    "simulators.__main__",
)
"""Where users enter: commands, routes, steps of jobs, pages."""


@dataclass(frozen=True)
class Tree:
    """The files of a checkout, or of a commit that was unpacked."""

    root: Path
    names: tuple[str, ...]

    def files(self, *tops: str, suffix: str = ".py") -> list[str]:
        """Files under any of the folders `tops`, by suffix."""
        return [n for n in self.names if n.endswith(suffix) and n.split("/")[0] in tops]

    def text(self, name: str) -> str:
        return (self.root / name).read_text(encoding="utf-8")

    def lines(self, names: Iterable[str]) -> int:
        return sum(self.text(n).count("\n") for n in names)


def working_tree() -> Tree:
    """Tracked and new files as they are."""
    listed = _git("ls-files", "--cached", "--others", "--exclude-standard").splitlines()
    return Tree(ROOT, tuple(sorted(n for n in set(listed) if (ROOT / n).is_file())))


def unpacked(commit: str, folder: Path) -> Tree:
    """The files of a commit, unpacked into `folder`."""
    data = subprocess.run(
        ["git", "archive", commit], cwd=ROOT, check=True, capture_output=True
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        archive.extractall(folder, filter="data")
    return Tree(folder, tuple(_git("ls-tree", "-r", "--name-only", commit).splitlines()))


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


# Imports


def module_name(file: str) -> str:
    return file.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def imports(tree: Tree, modules: dict[str, str]) -> dict[str, set[str]]:
    """For each module the modules that it imports, inside functions and for types included."""
    return {name: imports_of(tree, file, modules) - {name} for name, file in modules.items()}


def imports_of(tree: Tree, file: str, modules: dict[str, str]) -> set[str]:
    """The modules among `modules` that a file imports."""
    name, wanted = module_name(file), set()
    package = name if file.endswith("__init__.py") else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(tree.text(file))):
        if isinstance(node, ast.Import):
            wanted.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parts, *filter(None, [node.module])])
            inside = [f"{base}.{a.name}" for a in node.names]
            wanted.update(m if m in modules else base for m in inside)
    return wanted & modules.keys()


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Sets of modules that import each other: Tarjan's strongly connected components."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
            if other in stack:
                low[node] = min(low[node], low[other])
        if low[node] == index[node]:
            at = stack.index(node)
            if len(stack) - at > 1:
                found.append(sorted(stack[at:]))
            del stack[at:]

    sys.setrecursionlimit(10_000)
    for node in graph:
        if node not in index:
            visit(node)
    return found


def part_of(file: str) -> str:
    """A package's folder, or the package for the files in it."""
    parts = file.split("/")
    return "/".join(parts[:2]) if len(parts) > 2 else parts[0]


def reached_by(graph: dict[str, set[str]], entries: list[str]) -> dict[str, dict[str, int]]:
    """For each module the entries that reach it, with the number of imports in between."""
    found: dict[str, dict[str, int]] = defaultdict(dict)
    for entry in entries:
        queue = deque([(entry, 0)])
        while queue:
            node, far = queue.popleft()
            if entry in found[node]:
                continue
            found[node][entry] = far
            queue.extend((other, far + 1) for other in graph[node])
    return found


# The old vocabulary


@dataclass(frozen=True)
class Word:
    text: re.Pattern[str] | None
    name: re.Pattern[str] | None
    use: str


def vocabulary() -> list[Word]:
    """The list beside this script."""
    read = tomllib.loads((Path(__file__).parent / "vocabulary.toml").read_text())

    def compiled(entry: dict[str, str], key: str) -> re.Pattern[str] | None:
        return re.compile(rf"\b(?:{entry[key]})\b", re.IGNORECASE) if key in entry else None

    return [Word(compiled(w, "text"), compiled(w, "name"), w["use"]) for w in read["word"]]


@dataclass(frozen=True)
class Entry:
    """One find: where, which word, what to write."""

    place: str
    found: str
    use: str


def in_text(place: str, text: str, words: list[Word]) -> Iterator[Entry]:
    for word in words:
        for match in word.text.finditer(text) if word.text else ():
            line = text.count("\n", 0, match.start())
            file, _, first = place.partition(":")
            yield Entry(f"{file}:{int(first or 1) + line}", match[0], word.use)


def prose(page: str) -> str:
    """A page without its code."""
    return re.sub(r"```.*?```|`[^`\n]*`", lambda m: "\n" * m[0].count("\n"), page, flags=re.DOTALL)


def split_name(name: str) -> list[str]:
    """An identifier and its words."""
    parts = re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", name)
    return [name.strip("_").lower(), *(p.lower() for p in parts)]


def in_name(place: str, name: str, words: list[Word]) -> Iterator[Entry]:
    parts = split_name(name)
    for word in words:
        if word.name and any(word.name.fullmatch(p) for p in parts):
            yield Entry(place, name, word.use)


def python_entries(tree: Tree, file: str, words: list[Word]) -> dict[str, list[Entry]]:
    """Entries of a module: in public names, in strings that users read, in comments."""
    text = tree.text(file)
    module = ast.parse(text)
    docs: set[int] = set()
    names: list[tuple[int, str]] = []
    found: dict[str, list[Entry]] = {"names": [], "ui": [], "comments": []}
    for node in ast.walk(module):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for part in node.body:  # docstrings, of constants and fields too
                if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant):
                    docs.add(id(part.value))
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            names.append((node.lineno, node.name))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name[0] != "_":
            names += [(a.lineno, a.arg) for a in [*node.args.args, *node.args.kwonlyargs]]
    for owner in [module, *(n for n in ast.walk(module) if isinstance(n, ast.ClassDef))]:
        for part in owner.body:
            targets = part.targets if isinstance(part, ast.Assign) else [getattr(part, "target", 0)]
            names += [(t.lineno, t.id) for t in targets if isinstance(t, ast.Name)]
    for line, name in names:
        if not name.startswith("_"):
            found["names"] += in_name(f"{file}:{line}", name, words)
    for node in ast.walk(module):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            kind = "comments" if id(node) in docs else "ui"
            if kind == "ui" and " " not in node.value:
                continue  # a key, not a sentence
            said = prose(node.value) if kind == "comments" else node.value
            found[kind] += in_text(f"{file}:{node.lineno}", said, words)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            found["comments"] += in_text(f"{file}:{token.start[0]}", token.string, words)
    return found


def test_name_entries(tree: Tree, file: str, words: list[Word]) -> Iterator[Entry]:
    """Entries in the names that a test module defines; a test's own name is read as a sentence."""
    names: dict[str, int] = {}
    for node in ast.walk(ast.parse(tree.text(file))):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
                names.setdefault(name, node.lineno)
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                names.setdefault(name, node.lineno)
    for name, line in names.items():
        if name.startswith("test_"):
            yield from in_text(f"{file}:{line}", name.replace("_", " "), words)
        else:
            yield from in_name(f"{file}:{line}", name, words)


def page_entries(tree: Tree, file: str, words: list[Word]) -> dict[str, list[Entry]]:
    """Entries of a script, style sheet or page: in names, comments, and text that users see."""
    code = tree.text(file)
    found: dict[str, list[Entry]] = {"js names": [], "js comments": [], "ui": []}

    def place(at: int) -> str:
        return f"{file}:{code.count(chr(10), 0, at) + 1}"

    def blank(match: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", match[0])

    comment = re.compile(r"/\*.*?\*/|<!--.*?-->|(?<!:)//[^\n]*", re.DOTALL)
    for match in comment.finditer(code):
        found["js comments"] += in_text(place(match.start()), match[0], words)
    bare = comment.sub(blank, code)
    if file.endswith(".html"):
        found["ui"] += in_text(file, bare, words)
        return found
    for match in re.finditer(r"\"[^\"\n]*\"|'[^'\n]*'|`[^`]*`", bare):
        if " " in match[0]:  # a sentence, not a key
            found["ui"] += in_text(place(match.start()), match[0], words)
    names: dict[str, int] = {}
    for match in re.finditer(r"[A-Za-z_$][\w$]*", re.sub(r"\"[^\"\n]*\"", blank, bare)):
        names.setdefault(match[0], match.start())
    for name, at in names.items():
        found["js names"] += in_name(place(at), name, words)
    return found


def old_words(tree: Tree) -> dict[str, list[Entry]]:
    """Entries by kind: docs, ui, names, comments, and those of scripts and of tests' names."""
    words = vocabulary()
    kinds = ("docs", "ui", "names", "comments", "js names", "js comments", "test names")
    found: dict[str, list[Entry]] = {kind: [] for kind in kinds}
    for page in [p for p in hand_written(tree) if p != "CHANGELOG.md"]:
        found["docs"] += in_text(page, prose(tree.text(page)), words)
    files = [(file, python_entries) for file in tree.files(*PACKAGES)]
    for suffix in (".js", ".mjs", ".html", ".css"):
        files += [(file, page_entries) for file in tree.files("stage_service", suffix=suffix)]
    for file, entries_of in files:
        for kind, entries in entries_of(tree, file, words).items():
            found[kind] += entries
    for file in tree.files("tests"):
        found["test names"] += test_name_entries(tree, file, words)
    return found


# Figures


def hand_written(tree: Tree) -> list[str]:
    """README and the pages of docs/ that no command writes."""
    pages = ["README.md", *tree.files("docs", suffix=".md")]
    return [p for p in pages if not tree.text(p).startswith(GENERATED)]


def word_count(tree: Tree, pages: Iterable[str]) -> int:
    return sum(len(tree.text(p).split()) for p in pages)


@dataclass
class Ledger:
    """Figures of a tree, and the lists behind them."""

    figures: dict[str, int]
    parts: list[dict[str, object]] = field(default_factory=list)
    long: dict[str, int] = field(default_factory=dict)
    circles: list[list[str]] = field(default_factory=list)
    words: dict[str, list[Entry]] = field(default_factory=dict)


def ledger(tree: Tree) -> Ledger:
    """Measure a tree."""
    product = tree.files(*PACKAGES)
    modules = {module_name(f): f for f in product}
    graph = imports(tree, modules)
    words = old_words(tree)
    long = {f: n for f in product if (n := tree.lines([f])) > LONG}
    loops = circles(graph)
    pages = [p for p in hand_written(tree) if p != "README.md"]
    figures = {
        "product lines": tree.lines(product),
        "test lines": tree.lines(tree.files("tests")),
        f"files over {LONG} lines": len(long),
        "circles of imports": len(loops),
        "docs words by hand": word_count(tree, pages),
        "README words": word_count(tree, ["README.md"]),
        "CHANGELOG lines": tree.lines(["CHANGELOG.md"]),
        **{f"old vocabulary, {kind}": len(entries) for kind, entries in words.items()},
    }
    return Ledger(figures, parts(tree, modules, graph), long, loops, words)


def parts(
    tree: Tree, modules: dict[str, str], graph: dict[str, set[str]]
) -> list[dict[str, object]]:
    """Each part's lines, its tests' lines, what of the user's entries and benchmarks reach it."""
    entries = [m for m in modules if m.startswith(ENTRIES)]
    reach = reached_by(graph, entries)
    measured = benchmark_imports(tree, modules)
    tests: Counter[str] = Counter()
    for file in tree.files("tests"):
        tests[part_of(file.removeprefix("tests/"))] += tree.lines([file])
    rows: list[dict[str, object]] = []
    for part in sorted({part_of(f) for f in modules.values()}):
        files = [f for f in modules.values() if part_of(f) == part]
        inside = {module_name(f) for f in files}
        nearest: Counter[str] = Counter()
        for module in inside:
            for entry, far in reach.get(module, {}).items():
                if entry not in inside:
                    nearest[entry] = max(nearest[entry], 100 - far)
        names = [n.removeprefix("stage_service.") for n, _ in nearest.most_common(3)]
        if any(m.startswith(ENTRIES) for m in inside):
            names = ["an entry itself"]
        rows.append(
            {
                "part": part,
                "lines": tree.lines(files),
                "tests": tests[part],
                "reached by": ", ".join(names) or "nothing",
                "benchmarks": ", ".join(sorted(b for b, used in measured.items() if used & inside)),
            }
        )
    return rows


def benchmark_imports(tree: Tree, modules: dict[str, str]) -> dict[str, set[str]]:
    """For each folder or file of tests/benchmarks the product's modules that it imports."""
    found: dict[str, set[str]] = defaultdict(set)
    for file in tree.files("tests"):
        if file.startswith("tests/benchmarks/") and "/tests/" not in file.removeprefix("tests/"):
            name = file.removeprefix("tests/benchmarks/").split("/")[0].removesuffix(".py")
            found[name] |= imports_of(tree, file, modules)
    return found


def report(now: Ledger, before: Ledger | None, args: argparse.Namespace) -> str:
    """The ledger as text."""
    lines = []
    for name, value in now.figures.items():
        old = f"{before.figures[name]:>10,}" if before else ""
        lines.append(f"{name:<28}{old}{value:>10,}")
    lines += ["", f"files over {LONG} lines:"]
    lines += [f"  {n:>5}  {f}" for f, n in sorted(now.long.items(), key=lambda x: -x[1])]
    folders = Counter(part_of(f) for f in now.long)
    lines += [f"  by folder: {', '.join(f'{k} {n}' for k, n in folders.most_common())}"]
    lines += ["circles of imports:", *(f"  {' ↔ '.join(loop)}" for loop in now.circles)]
    if args.parts:
        lines += ["", f"{'part':<36}{'lines':>7}{'tests':>7}  reached by | benchmarks"]
        lines += [
            f"{r['part']:<36}{r['lines']:>7,}{r['tests']:>7,}  "
            f"{r['reached by']} | {r['benchmarks']}"
            for r in now.parts
        ]
    for kind, entries in now.words.items() if args.words else ():
        lines += ["", f"old vocabulary, {kind}:"]
        lines += [f"  {e.place}: {e.found} → {e.use}" for e in entries]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the ledger."""
    parser = argparse.ArgumentParser(prog="make ledger", description=__doc__)
    parser.add_argument("--before", metavar="COMMIT", help="measure this commit beside it")
    parser.add_argument("--parts", action="store_true", help="the table of parts")
    parser.add_argument("--words", action="store_true", help="every entry of the old vocabulary")
    parser.add_argument("--json", action="store_true", help="everything as JSON")
    args = parser.parse_args()
    now, before = ledger(working_tree()), None
    if args.before:
        with tempfile.TemporaryDirectory() as folder:
            before = ledger(unpacked(args.before, Path(folder)))
    if args.json:
        whole = {"figures": now.figures, "parts": now.parts, "long": now.long}
        whole["words"] = {k: [vars(e) for e in v] for k, v in now.words.items()}
        print(json.dumps({**whole, "before": before.figures if before else None}, indent=1))
    else:
        print(report(now, before, args), end="")


if __name__ == "__main__":
    main()
