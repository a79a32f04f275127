"""
Parts of a kernel: linked nearly as they are, optimised and made machine code where the whole is.

Numba optimises every function that compiled code calls, and makes machine code of it, before it
does so again wherever that one is linked in: some ten times for a kernel deep in a step. Arguments
are those of ``arguments``. An index is not asked whether it is negative: only constants may be.
"""

from llvmlite import binding, ir
from numba import types
from numba.core import codegen, compiler
from numba.core.caching import CompileResultCacheImpl
from numba.core.datamodel import register_default
from numba.core.imputils import lower_getattr_generic
from numba.extending import lower_builtin, lower_cast, unbox
from numba.np import arrayobj

from xpbd_ros.sim.backend.arguments import field, made, tuple_model, unboxed
from xpbd_ros.sim.backend.locked_cache import LockedCache
from xpbd_ros.sim.backend.narrowing import cast_fields

KERNELS: set[int] = set()
"""addresses of all kernels, as Numba writes them down where one is called, to no use"""
ADDRESS = 'numba.dynamic.globals.'
"""where it does so; code with addresses that are of use cannot be kept for other processes"""
NEEDLESS = ('inline_closure_likes', 'inline_inlinables', 'inline_overloads', 'literal_unroll',
            'make_function_op_code_to_jit_function', 'with_lifting')
"""passes for what kernels lack: closures, comprehensions, inlining before typing, ``with``"""
MOST_FIELDS = 32
"""of a named tuple that a kernel makes"""

register_default(types.NamedTuple)(tuple_model)
lower_getattr_generic(types.NamedTuple)(field)
unbox(types.NamedTuple)(unboxed)
lower_cast(types.NamedTuple, types.NamedTuple)(cast_fields)
for _count in range(2, MOST_FIELDS + 1):    # Numba's own takes any number, which is less specific
    lower_builtin(types.NamedTupleClass, *[types.Any] * _count)(made)


def _index(context, builder, kind, index, size, wrapped=arrayobj.fix_integer_index):
    """Return an index; in the code of kernels one from the start, unless it is a constant."""
    if isinstance(index, ir.Constant) or not getattr(builder.module, 'is_kernel', False):
        return wrapped(context, builder, kind, index, size)
    return context.cast(builder, index, kind, types.intp)


arrayobj.fix_integer_index = _index


class KernelLibrary(codegen.JITCodeLibrary):
    """Code of kernels."""

    def create_ir_module(self, name):
        """Return a module that says so."""
        module = super().create_ir_module(name)
        module.is_kernel = True
        return module


class Library(KernelLibrary):
    """The code of one part, and of all that it calls."""

    def add_llvm_module(self, module):
        """Take code, simplified a little."""
        module.data_layout = self._codegen._data_layout
        if hasattr(binding, 'create_new_function_pass_manager'):
            self._simplify(module)
        self._final_module.link_in(module)

    def _simplify(self, module):
        """
        Remove copies of arguments.

        Instructions that take tuples apart and put them together are most of a part. Every caller
        that the part is linked into would keep them up to its own optimisation. Instructions are
        combined first: split up as it stands, each use of a tuple would read all of its fields.
        """
        passes = binding.create_new_function_pass_manager()
        passes.add_instruction_combine_pass()
        passes.add_sroa_pass()
        builder = binding.create_pass_builder(self._codegen._tm,
                                              binding.create_pipeline_tuning_options())
        for function in module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _optimize_final_module(self):
        pass

    def _finalize_dynamic_globals(self):
        for each in self._final_module.global_variables:
            start, _, address = each.name.partition(ADDRESS)
            if not start and int(address.split('.')[0], 16) in KERNELS:
                each.name = 'kernel.' + address
        super()._finalize_dynamic_globals()

    def _finalize_final_module(self):
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == binding.Linkage.external:
                function.linkage = 'linkonce_odr'    # several kernels may hold it
        self._shared_module = self._final_module
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name):
        """Nobody can call it."""
        return 0

    @property
    def codegen(self):
        """What is asked to write down where the globals of Python are: nowhere."""
        return self

    def set_env(self, name, env):
        """Do without."""

    def serialize_using_object_code(self):
        """Return what ``read`` needs."""
        return self.name, self._final_module.as_bitcode()

    @classmethod
    def read(cls, target, name, bitcode):
        """Return a library that was serialised."""
        library = cls(target.codegen(), name)
        library._final_module = binding.parse_bitcode(bitcode)
        library._shared_module = library._final_module
        library._finalize_dynamic_globals()
        library._finalized = True
        return library


class WholeLibrary(KernelLibrary):
    """The code of a kernel that Python calls, with all parts linked in."""

    def _optimize_final_module(self):
        """
        Give the parts internal linkage, so that LLVM removes their unused arguments; optimise.

        They are renamed: MCJIT would resolve calls of the same part in another library, which
        passes all arguments, to the one that has lost some.
        """
        for function in self._final_module.functions:
            if function.linkage == binding.Linkage.linkonce_odr and not function.is_declaration:
                function.linkage = 'internal'
                function.name = f'own.{function.name}'
        super()._optimize_final_module()


class Pipeline(compiler.Compiler):
    """Numba's compiler, without passes for what kernels do not have."""

    def define_pipelines(self):
        """Return the passes."""
        pipelines = super().define_pipelines()
        for each in pipelines:
            each.passes = [known for known in each.passes if known[0].name() not in NEEDLESS]
        return pipelines


class Compiler(Pipeline):
    """For parts."""

    def __init__(self, typing, target, library, *rest):
        super().__init__(typing, target, Library(target.codegen(), 'part'), *rest)


class WholeCompiler(Pipeline):
    """For kernels that Python calls."""

    def compile_extra(self, func):
        """Compile a function."""
        library = WholeLibrary(self.state.targetctx.codegen(), func.__qualname__)
        library.enable_object_caching()
        self.state.library = library
        return super().compile_extra(func)


class CacheImpl(CompileResultCacheImpl):
    """Numba's cache, for parts."""

    def rebuild(self, target, payload):
        """Return what ``reduce`` was given."""
        code, fndesc, env, signature, *_ = payload
        library = Library.read(target, *code)
        return compiler.compile_result(
            target_context=target, typing_context=target.typing_context, library=library,
            environment=env, entry_point=target.get_executable(library, fndesc, env),
            fndesc=fndesc, signature=signature, objectmode=False, lifted=(), reload_init=())


class PartCache(LockedCache):
    """The disk cache of parts."""

    _impl_class = CacheImpl
