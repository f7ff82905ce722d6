"""Machine code for this processor from LLVM's text, kept on disk for the next process."""

from __future__ import annotations

import ctypes
import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import llvmlite.binding as llvm

_ENGINES: list[llvm.ExecutionEngine] = []  # machine code lives as long as its engine


@cache
def width() -> int:
    """Lanes of a vector: 16 with AVX-512, whose registers hold as many float32; 8 elsewhere."""
    return 16 if llvm.get_host_cpu_features().get("avx512f") else 8


@cache
def _machine() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features().flatten()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=2, jit=True
    )


def compiled(text: str, function: str, folder: Path | None) -> ctypes.c_void_p:
    """The address of ``function`` of a module in LLVM's text.

    folder: where machine code is kept, by a digest of the text, the processor and LLVM's version.
    """
    processor = f"{llvm.get_host_cpu_name()}|{llvm.get_host_cpu_features().flatten()}"
    code = kept(text, processor, ".o", folder, lambda: _machine().emit_object(optimised(text)))
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return ctypes.c_void_p(engine.get_function_address(function))


def kept(text: str, built_for: str, suffix: str, folder: Path | None, build: Callable[[], bytes]) -> bytes:
    """The code that ``build`` makes of a text, from the folder if it was built for the same before."""
    if folder is None:
        return build()
    path = folder / f"{_digest('|'.join((text, built_for, str(llvm.llvm_version_info))).encode())}{suffix}"
    with suppress(OSError):
        data = path.read_bytes()
        # A file begins with the digest of what follows: LLVM would end the process over a damaged one.
        if data[:64] == _digest(data[64:]).encode():
            return data[64:]
    code = build()
    with suppress(OSError):  # a folder that cannot be written costs the next process some seconds, nothing else
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".part", delete=False) as file:
            file.write(_digest(code).encode() + code)
        os.replace(file.name, path)  # whole or not at all
    return code


def assembly(text: str, triple: str, processor: str) -> str:
    """A module as another processor's assembly, such as PTX."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple).create_target_machine(cpu=processor, opt=3)
    return target.emit_assembly(optimised(text, target))


def optimised(text: str, target: llvm.TargetMachine | None = None) -> llvm.ModuleRef:
    """The module as LLVM makes it better for a processor, this one if none is given; ``str`` gives its text."""
    module = llvm.parse_assembly(text)
    if target is not None:
        module.triple, module.data_layout = target.triple, str(target.target_data)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    # Every number is a vector already, and what is a loop shall stay one.
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = False
    builder = llvm.create_pass_builder(target or _machine(), options)
    builder.getModulePassManager().run(module, builder)
    return module


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
