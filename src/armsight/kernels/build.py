"""Compile the package's kernels into one extension module: numba writes LLVM's code for them, here and never at run time.

In: the modules of ``armsight`` that import :mod:`armsight.kernels`, a target. Out: ``armsight/kernels/_compiled`` for
that target. Three stages: each module's kernels become LLVM's intermediate code (the same for all targets), that is
optimised and compiled to an object file for a processor, and zig links the objects with ``call.c``. The first two are kept
in ``build/kernels`` under a digest of everything that went into them, as make would keep objects.

``python -m armsight.kernels.build [TARGET]`` builds for this machine or for one of :data:`TARGETS`.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib
import importlib.abc
import importlib.machinery
import os
import platform
import re
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

from armsight.errors import InputError
from armsight.kernels import decorator as kernels

PACKAGE = Path(__file__).resolve().parents[1]
#: In the checkout; stages that are done are found there.
CACHE = PACKAGE.parents[1] / "build" / "kernels"


@dataclass(frozen=True)
class Platform:
    """A kind of machine by LLVM's ``triple`` and zig's name of it, and the extension module's file name.

    ``levels``: processors, the newest first: the first that a machine has is used there.
    """

    triple: str
    zig: str
    levels: tuple[str, ...]
    library: str


#: x86-64-v3 has AVX2 and FMA (2013 and later); older processors get the second.
TARGETS = {
    "linux-x86_64": Platform(
        "x86_64-unknown-linux-gnu", "x86_64-linux-gnu.2.17", ("x86-64-v3", "x86-64"), "_compiled.abi3.so"
    ),
    "linux-aarch64": Platform(
        "aarch64-unknown-linux-gnu", "aarch64-linux-gnu.2.17", ("cortex-a72",), "_compiled.abi3.so"
    ),
    "macos-arm64": Platform("arm64-apple-macosx11.0.0", "aarch64-macos.11.0", ("apple-m1",), "_compiled.abi3.so"),
    "windows-x86_64": Platform("x86_64-pc-windows-gnu", "x86_64-windows-gnu", ("x86-64-v3", "x86-64"), "_compiled.pyd"),
}
_LETTERS = {name: letter for letter, name in kernels.LETTERS.items()}
_KINDS = {"f": "float", "i": "int", "u": "uint"}


def this_machine() -> str:
    """Return the name of the target that this process runs on; InputError where none is known."""
    system = {"Linux": "linux", "Darwin": "macos", "Windows": "windows"}.get(platform.system(), platform.system())
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    name = f"{system}-{'arm64' if system == 'macos' and machine == 'aarch64' else machine}"
    if name not in TARGETS:
        raise InputError(
            f"{name}: kernels are compiled for {', '.join(TARGETS)}; others run with ARMSIGHT_KERNELS=python"
        )
    return name


# ---- which modules, and what each is made of ----


@functools.cache
def _imported(path: Path) -> list[Path]:
    found = []
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        names: list[str] = []
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{each.name}" for each in node.names)]
        elif isinstance(node, ast.Import):
            names = [each.name for each in node.names]
        for name in names:
            at = PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py")
            if name.startswith("armsight.") and at.exists():
                found.append(at)
    return found


def kernel_modules() -> list[Path]:
    """Return the files of all modules that have kernels."""
    found = (path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE / "kernels")
    return sorted(p for p in found if "from armsight.kernels import kernel" in p.read_text(encoding="utf-8"))


def _constants_from(path: Path) -> list[Path]:
    """Return the files that a module takes constants from: their values stand in the compiled code."""
    imports = (node for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom))
    names = [node.module for node in imports if node.module and any(each.name.isupper() for each in node.names)]
    return [PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names if name[:9] == "armsight."]


def compiled_sources() -> list[Path]:
    """Return the files whose code was compiled: an edit of one makes it stale."""
    modules = kernel_modules()
    return sorted({*modules, *(each for path in modules for each in _constants_from(path) if each.exists())})


def module_name(path: Path) -> str:
    """Return the name that a file of the package is imported by."""
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)


def _key(path: Path) -> str:
    """Return a digest of what a module's compiled code depends on: its code, what that imports, and the compilers."""
    import llvmlite
    import numba
    import numpy as np

    seen, todo = set[Path](), [path]
    while todo:
        each = todo.pop()
        if each not in seen:
            seen.add(each)
            todo.extend(_imported(each))
    parts = [numba.__version__, llvmlite.__version__, np.__version__, sys.version]
    parts += [kernels.code_digest(each) for each in (*sorted(seen), Path(__file__))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:20]


# ---- Python to LLVM's intermediate code ----


@dataclass(frozen=True)
class _Called:
    """A kernel that Python calls."""

    dispatcher: Any
    function: Any
    signatures: tuple[str, ...]
    nogil: bool


def _numba_types() -> Any:  # noqa: ANN401 - numba's own annotations of it do not hold
    return importlib.import_module("numba.core.types")


def _types(text: str, function: Any) -> tuple[Any, ...]:  # noqa: ANN401
    types = _numba_types()

    numbers = {name: getattr(types, f"{_KINDS[name[0]]}{8 * int(name[1])}") for name in _LETTERS if name != "?"}
    numbers["b1"] = types.boolean

    def const(array: Any) -> Any:  # noqa: ANN401
        return types.Array(array.dtype, array.ndim, array.layout, readonly=True)

    def typed(value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, type):
            value = value(*evaluate(value.kernel_types, sys.modules[value.__module__].__dict__))  # type: ignore[attr-defined]
        if isinstance(value, tuple):
            members = [typed(each) for each in value]
            return types.Tuple(members) if type(value) is tuple else types.NamedTuple(members, type(value))
        return value

    def evaluate(text: str, scope: dict[str, Any]) -> tuple[Any, ...]:
        text = re.sub(r"const (\w+\[[^\]]*\])", r"const(\1)", text)
        return tuple(map(typed, eval(f"({text},)", scope, {**numbers, "const": const})))

    return evaluate(text, function.__globals__)


def _code(kind: Any) -> str:  # noqa: ANN401
    """Return the letters (call.c) of one of numba's types."""
    types = _numba_types()

    if isinstance(kind, types.Array):
        return f"[{'w' if kind.mutable else 'r'}{_code(kind.dtype)}{kind.ndim}{kind.layout}"
    if isinstance(kind, types.BaseTuple):
        return f"({''.join(map(_code, kind))})"
    if kind in (types.none, types.void):
        return "n"
    if isinstance(kind, types.Boolean):
        return "b"
    if isinstance(kind, types.Literal):
        return _code(kind.literal_type)
    letter = _LETTERS.get(f"{str(kind)[0]}{getattr(kind, 'bitwidth', 0) // 8}")
    if letter is None:
        raise InputError(f"{kind}: no kernel takes or gives such numbers")
    return letter


def _emit_entry(context: Any, library: Any, result: Any, symbol: str) -> None:  # noqa: ANN401
    """Add a function ``int symbol(const uint64_t *arguments, uint64_t *result)`` that calls a compiled kernel."""
    from llvmlite import ir

    types = _numba_types()

    word, described = ir.IntType(64), result.fndesc
    module = context.create_module(symbol)
    entry = ir.Function(module, ir.FunctionType(ir.IntType(32), [word.as_pointer()] * 2), symbol)
    kernel = ir.Function(
        module, context.call_conv.get_function_type(described.restype, described.argtypes), described.llvm_func_name
    )
    builder = ir.IRBuilder(entry.append_basic_block())
    at = [0]

    def address(start: Any, words: int) -> Any:  # noqa: ANN401
        here = builder.gep(start, [ir.Constant(word, at[0])])
        at[0] += words
        return here

    def take(kind: Any) -> Any:  # noqa: ANN401
        model = context.data_model_manager[kind]
        if isinstance(kind, types.BaseTuple):
            return context.make_tuple(builder, kind, [take(each) for each in kind])
        words = 5 + 2 * kind.ndim if isinstance(kind, types.Array) else 1
        here = builder.bitcast(address(entry.args[0], words), model.get_data_type().as_pointer())
        value = model.load_from_data_pointer(builder, here)
        if isinstance(kind, types.Array):
            # Its memory is Python's: said here, so that the compiler drops the counting of references to it.
            nothing = ir.Constant(ir.IntType(8).as_pointer(), None)
            value = builder.insert_value(builder.insert_value(value, nothing, 0), nothing, 1)
        return value

    def give(kind: Any, value: Any) -> None:  # noqa: ANN401
        if isinstance(kind, types.BaseTuple):
            for n, each in enumerate(kind):
                give(each, builder.extract_value(value, n))
        elif kind not in (types.none, types.void):
            model = context.data_model_manager[kind]
            words = 5 + 2 * kind.ndim if isinstance(kind, types.Array) else 1
            data = model.as_data(builder, value)
            builder.store(data, builder.bitcast(address(entry.args[1], words), data.type.as_pointer()))

    arguments = [take(kind) for kind in described.argtypes]
    status, value = context.call_conv.call_function(builder, kernel, described.restype, described.argtypes, arguments)
    with builder.if_then(status.is_error, likely=False):
        builder.ret(ir.Constant(ir.IntType(32), 1))
    at[0] = 0
    give(described.restype, value)
    builder.ret(ir.Constant(ir.IntType(32), 0))
    library.add_ir_module(module)


def _prepare_numba() -> Any:  # noqa: ANN401
    """Make numba gather code in place of optimising and loading it; return its context."""
    from numba.core import callconv, codegen
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.registry import cpu_target
    from numba.core.runtime import nrtdynmod, rtsys

    class Library(codegen.AOTCodeLibrary):  # type: ignore[misc]
        """Code as it was written, apart from that of what it calls; :func:`_linked` puts them together, each once."""

        def _optimize_functions(self, ll_module: Any) -> None:  # noqa: ANN401
            ll_module.data_layout = self._codegen._data_layout

        def finalize(self) -> None:
            self._finalized = True

    class Codegen(codegen.AOTCPUCodegen):  # type: ignore[misc]
        _library_class = Library

        def set_env(self, *_: Any) -> None:  # noqa: ANN401
            pass

    # A kernel that fails says so; what it raised nobody reads, and making it needs more of Python than call.c has.
    for name in ("set_static_user_exc", "set_dynamic_user_exc"):
        setattr(callconv.CPUCallConv, name, lambda *_, **__: None)
    context = cpu_target.target_context
    context.refresh()
    context._internal_codegen = Codegen("armsight")
    context.get_executable = lambda *_: [].append  # numba knows each by a built-in function of its own; none is called
    module, library = nrtdynmod.create_nrt_module(context)
    for function in module.functions:
        function.attributes.discard("noinline")  # the last passes may; the first, which pair counts, do not inline
    with global_compiler_lock:
        library.add_ir_module(module)
        library.finalize()
    rtsys._library = library
    return context


def _linked(library: Any) -> bytes:  # noqa: ANN401
    """Return the bitcode of a library with all that it calls."""
    seen: list[Any] = []

    def walk(each: Any) -> None:  # noqa: ANN401
        if each not in seen:
            seen.append(each)
            for one in each._linking_libraries:
                walk(one)

    walk(library)
    module = library._final_module
    for each in seen:
        for function in each._final_module.functions:
            if function.name.startswith("__excinfo"):  # each module that can fail has it
                function.linkage = "linkonce_odr"
    for each in seen[1:]:
        module.link_in(each._final_module, preserve=True)
    module.verify()
    return bytes(module.as_bitcode())


def _gather() -> dict[str, list[_Called]]:
    """Set the decorator to collect kernels; the dictionary fills as modules are imported."""
    import numba

    called: dict[str, list[_Called]] = {}

    def collect(function: Any, signatures: tuple[str, ...], options: dict[str, Any]) -> Any:  # noqa: ANN401
        options = {"error_model": "numpy", **options}
        nogil = options.pop("nogil", False)
        dispatcher = numba.njit(**options, no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
        if signatures:
            called.setdefault(function.__module__, []).append(_Called(dispatcher, function, signatures, nogil))
        return dispatcher

    kernels.builder = collect
    return called


@functools.cache
def _third_party() -> set[str]:
    """Return what the package's modules import from elsewhere, by its first name."""
    names = set[str]()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names.add(node.module.split(".")[0])
    return names - {"armsight", *sys.stdlib_module_names}


class _Absent(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Stands in for packages that are not installed where the package is built: kernels need none but numpy.

    Last in ``sys.meta_path``: what is installed was found before. What installed packages try to import stays absent.
    """

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:  # noqa: ANN401
        known = name.split(".")[0] in _third_party()
        return importlib.machinery.ModuleSpec(name, self, is_package=True) if known else None

    def create_module(self, spec: Any) -> Any:  # noqa: ANN401
        return mock.MagicMock(name=spec.name, __path__=[], __spec__=spec)

    def exec_module(self, module: Any) -> None:  # noqa: ANN401
        pass


def import_alone(name: str) -> None:
    """Import a module of the package whose requirements, but for numpy, need not be installed."""
    absent = _Absent()
    sys.meta_path.append(absent)
    try:
        importlib.import_module(name)
    finally:
        sys.meta_path.remove(absent)


_worker: list[Any] = []


def _intermediate(path: Path) -> Path:
    """Write a module's kernels as LLVM's bitcode, beside a table of its signatures; return its file."""
    name, key = module_name(path), _key(path)
    out = CACHE / "intermediate" / f"{name}-{key}.bc"
    if out.exists():
        return out
    if not _worker:
        _worker.extend((_gather(), _prepare_numba()))
    called, context = _worker
    from numba.core.compiler_lock import global_compiler_lock

    import_alone(name)
    library, lines = context.codegen().create_library(name), []
    with global_compiler_lock:
        for each in called.get(name, ()):
            for n, text in enumerate(each.signatures):
                types = _types(text, each.function)
                if len(types) != each.function.__code__.co_argcount:
                    raise InputError(f"{name}.{each.function.__name__}: signature {text!r} has {len(types)} types")
                try:
                    each.dispatcher.compile(types)
                except Exception as error:  # noqa: BLE001 - numba raises many kinds; said with the kernel's name
                    raise InputError(f"{path}: {each.function.__name__}, {text!r}: {error}") from None
                result = each.dispatcher.overloads[types]
                symbol = f"armsight_{name.replace('.', '_')}_{each.function.__name__}_{n}"
                library.add_linking_library(result.library)
                _emit_entry(context, library, result, symbol)
                takes, gives = "".join(map(_code, types)), _code(result.signature.return_type)
                lines.append(f"{each.function.__name__} {symbol} {takes or '-'} {gives} {int(each.nogil)}")
        library.finalize()
    out.parent.mkdir(parents=True, exist_ok=True)
    for old in out.parent.glob(f"{name}-*"):
        old.unlink()
    out.with_suffix(".txt").write_text("\n".join(lines), encoding="utf-8")
    out.write_bytes(_linked(library))
    return out


# ---- intermediate code to objects, objects to a library ----


def _features() -> set[str]:
    """Return what this machine's processor has, as LLVM names it."""
    import llvmlite.binding as ll

    return set(ll.get_host_cpu_features().flatten().split(","))


def _suffix(level: str) -> str:
    return level.replace("-", "_")


def _object(bitcode: Path, target: Platform, level: str) -> Path:
    """Optimise one module's code for a processor and write it as an object file; return its path."""
    import llvmlite.binding as ll

    out = CACHE / f"{target.zig}-{level}" / (bitcode.stem + ".o")
    if out.exists():
        return out
    ll.initialize_all_targets()
    ll.initialize_all_asmprinters()
    machine = ll.Target.from_triple(target.triple).create_target_machine(cpu=level, opt=3, reloc="pic")
    module = ll.parse_bitcode(bitcode.read_bytes())
    module.triple, module.data_layout = target.triple, str(machine.target_data)
    entries = [line.split()[1] for line in bitcode.with_suffix(".txt").read_text(encoding="utf-8").splitlines()]
    for function in module.functions:
        if not function.is_declaration:
            function.linkage = "external" if function.name in entries else "internal"
            if function.name in entries:
                function.visibility = "hidden"
                function.name = f"{function.name}_{_suffix(level)}"
    for value in module.global_variables:
        if not value.is_declaration:
            value.linkage = "internal"
    # First all is inlined and loops get their plain form, then counts of references go in pairs, then the whole of -O3.
    for first in (True, False):
        tuning = ll.create_pipeline_tuning_options(speed_level=0 if first else 3)
        tuning.loop_vectorization = not first
        tuning.slp_vectorization = False
        builder = ll.create_pass_builder(machine, tuning)
        passes = builder.getModulePassManager()
        if first:
            passes.add_sroa_pass()
            passes.add_simplify_cfg_pass()
            passes.add_loop_rotate_pass()
            passes.add_instruction_combine_pass()
            passes.add_jump_threading_pass()
        passes.add_refprune_pass()
        if first:
            passes.add_lower_atomic_pass()  # no array of a kernel's own is another thread's, too
        passes.run(module, builder)
    out.parent.mkdir(parents=True, exist_ok=True)
    for old in out.parent.glob(f"{bitcode.stem.rsplit('-', 1)[0]}-*"):
        old.unlink()
    out.write_bytes(machine.emit_object(module))
    return out


def _table(modules: list[Path], bitcodes: list[Path], target: Platform) -> str:
    """Return the C source with the signatures of all kernels, for each processor's level."""
    rows: list[tuple[str, ...]] = []
    for path, bitcode in zip(modules, bitcodes, strict=True):
        for line in bitcode.with_suffix(".txt").read_text(encoding="utf-8").splitlines():
            rows.append((module_name(path), *line.split()))
    text = ['#include "call.h"', ""]
    for level in map(_suffix, target.levels):
        text += [f"int {symbol}_{level}(const uint64_t *, uint64_t *);" for _, _, symbol, *_ in rows]
        text.append(f"static const Signature for_{level}[] = {{")
        for module, name, symbol, takes, gives, nogil in rows:
            text.append(f'    {{"{module}", "{name}", "{takes.strip("-")}", "{gives}", {symbol}_{level}, {nogil}}},')
        text.append("};")
    levels = ", ".join(f'{{"{name}", for_{_suffix(name)}}}' for name in target.levels)
    text += [
        f"const Level armsight_levels[] = {{{levels}}};",
        f"const int armsight_level_count = {len(target.levels)};",
    ]
    text.append(f"const int armsight_signature_count = {len(rows)};")
    text.append("const Source armsight_sources[] = {")
    sources = compiled_sources()
    digests = [f"{kernels.text_digest(path)}:{kernels.code_digest(path)}" for path in sources]
    text += [f'    {{"{module_name(path)}", "{both}"}},' for path, both in zip(sources, digests, strict=True)]
    text += ["};", f"const int armsight_source_count = {len(sources)};"]
    return "\n".join(text) + "\n"


def build(folder: Path, name: str | None = None) -> Path:
    """Compile all kernels for a target and write the extension module into a folder; return its path.

    Without a name it is for this very machine: for its processor's level only, in half the time.
    """
    target = TARGETS[name or this_machine()]
    if name is None and len(target.levels) > 1:
        has_newest = {"+avx2", "+fma", "+bmi2", "+movbe", "+lzcnt"} <= _features()
        target = replace(target, levels=target.levels[:1] if has_newest else target.levels[1:])
    modules = kernel_modules()
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        bitcodes = list(pool.map(_intermediate, sorted(modules, key=lambda p: -p.stat().st_size)))
        by_name = {bitcode.name.rsplit("-", 1)[0]: bitcode for bitcode in bitcodes}
        bitcodes = [by_name[module_name(path)] for path in modules]
        work = [(bitcode, target, level) for level in target.levels for bitcode in bitcodes]
        objects = list(pool.map(_object, *zip(*work, strict=True)))
    table = CACHE / target.zig / "table.c"
    table.parent.mkdir(parents=True, exist_ok=True)
    table.write_text(_table(modules, bitcodes, target), encoding="utf-8")
    here, made = Path(__file__).parent, CACHE / target.zig / target.library
    flags = ["-shared", "-O2", "-fPIC", "-std=c11", "-fvisibility=hidden", "-s", "-Wall", "-Wextra", f"-I{here}"]
    files = [table, here / "call.c", *objects]
    if "macos" in target.zig:
        flags += ["-undefined", "dynamic_lookup", f"-Wl,-install_name,@rpath/{target.library}"]
    if "linux" in target.zig:
        flags += ["-lm"]
    if "windows" in target.zig:
        files.append(_import_library(target))
    _zig("cc", "-target", target.zig, *flags, "-o", made, *files)
    folder.mkdir(parents=True, exist_ok=True)
    out = folder / target.library
    out.unlink(missing_ok=True)  # a process that has it loaded keeps it
    return Path(shutil.copy(made, out))


def _import_library(target: Platform) -> Path:
    """Write what Windows' linker needs to know of Python: the functions and data that call.c declares, in python3.dll."""
    source = (Path(__file__).parent / "call.c").read_text(encoding="utf-8")
    names: list[str] = []
    for declared in re.findall(r"^FROM_PYTHON (.+);$", source, re.MULTILINE):
        function = re.search(r"(\w+)\(", declared)
        names += [function[1]] if function else [f"{name} DATA" for name in re.findall(r"\w+(?=,|$)", declared)]
    listed = CACHE / target.zig / "python3.def"
    listed.write_text("\n  ".join(["LIBRARY python3.dll\nEXPORTS", *names, ""]), encoding="utf-8")
    out = listed.with_suffix(".lib")
    _zig("dlltool", "-m", "i386:x86-64", "-D", "python3.dll", "-d", listed, "-l", out)
    return out


def _zig(*arguments: str | Path) -> None:
    command = [sys.executable, "-m", "ziglang", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"{' '.join(command)} failed:\n{done.stderr}")


if __name__ == "__main__":
    print(build(Path(__file__).parent, sys.argv[1] if len(sys.argv) > 1 else None))
