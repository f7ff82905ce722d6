"""Machine code of this processor from LLVM's instructions, kept for the next process."""

from __future__ import annotations

import ctypes
import hashlib
import os
import tempfile
from functools import cache
from pathlib import Path

import llvmlite.binding as llvm

_ENGINES: list[llvm.ExecutionEngine] = []  # the code lives as long as its engine


@cache
def target() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features().flatten()
    chosen = llvm.Target.from_default_triple()
    return chosen.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=2, jit=True)


@cache
def width() -> int:
    """Numbers of 4 bytes in a register, times what keeps its units busy."""
    features = llvm.get_host_cpu_features()
    import os
    return int(os.environ.get("LW", 16 if features.get("avx512f") else 8))


def compile(text: str, function: str, kept: Path | None) -> ctypes.c_void_p:
    """Address of ``function`` in a module of LLVM's text."""
    machine = target()
    module = llvm.parse_assembly(text)
    module.verify()
    key = hashlib.sha256("\0".join([text, str(llvm.llvm_version_info), llvm.get_host_cpu_name()]).encode()).hexdigest()
    path = kept / f"{key}.o" if kept else None
    if path and path.exists():
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(path.read_bytes()))
    else:
        options = llvm.create_pipeline_tuning_options(speed_level=2)
        options.loop_unrolling = False
        options.slp_vectorization = False
        options.loop_vectorization = False
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(module, builder)
        code = machine.emit_object(module)
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
                file.write(code)
            os.replace(file.name, path)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return ctypes.c_void_p(engine.get_function_address(function))
