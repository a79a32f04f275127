"""
Kernels as PTX, NVIDIA's assembly language, by LLVM's NVPTX back end, which llvmlite contains.

No CUDA toolkit, driver or card is needed. Kernels that are called by others are kept as
unoptimised LLVM code (``linking``). Compiled with one lane (XPBD_ROS_VECTOR_BITS=32), the target
triple of a GPU and an entry function that reads the thread's index, that code is a GPU kernel: the
same source, with the same rounding. LLVM contracts no a*b + c without fast-math, so the bits are
the CPU's, and ``check_rounding`` refuses PTX that would round otherwise. Denormal float32 numbers
count as 0, as in the CPU's step (``denormals``). Denormal float64 numbers, below 2e-308, are kept.
"""

import re

from llvmlite import binding as llvm

from xpbd_ros.sim.backend.device_team import MEET_ALL, MEET_BLOCK

LAYOUT = 'e-p6:32:32-i64:64-i128:128-i256:256-v16:16-v32:32-n16:32:64'
TRIPLE = 'nvptx64-nvidia-cuda'
VERSION = '+ptx83'
"""of PTX: CUDA 12.3, whose kernels take more than 4 KiB of parameters"""
ENTRY = 'run'
"""name of the entry function in each module"""
THREADS = 256
"""threads of a block, at most"""
SLOT = 8
"""bytes that each parameter of a kernel takes"""
EXACT = ['add', 'sub', 'mul', 'fma', 'div', 'sqrt', 'rcp']
REGISTERS = ('tid', 'ntid', 'ctaid', 'nctaid')
OF_LIBM = ('sqrt', 'fabs', 'floor', 'ceil', 'trunc', 'rint')
"""functions that are exact, on a CPU as on a GPU"""
BARRIER = """{ // meet_all
.reg .pred %mp<3>;
.reg .b32 %mr<8>;
bar.sync 0;
mov.u32 %mr1, %tid.x;
setp.ne.s32 %mp1, %mr1, 0;
@%mp1 bra $L_done;
mov.u32 %mr1, %nctaid.x;
sub.s32 %mr1, -2147483647, %mr1;
mov.u32 %mr2, %ctaid.x;
setp.eq.s32 %mp1, %mr2, 0;
selp.b32 %mr1, %mr1, 1, %mp1;
fence.acq_rel.gpu;
atom.acq_rel.gpu.add.u32 %mr4, [GATE], %mr1;
$L_look:
ld.acquire.gpu.u32 %mr5, [GATE];
xor.b32 %mr5, %mr5, %mr4;
setp.ge.s32 %mp2, %mr5, 0;
@%mp2 bra $L_look;
fence.acq_rel.gpu;
$L_done:
bar.sync 0;
} // all met"""
"""
The barrier of all threads of a launch (as in CUDA's cooperative groups).

The first block adds 2^31 - (blocks - 1) to the gate, each other one 1, and all wait until the
highest bit has turned. Nothing needs to be reset. All blocks must be on the card at once.
"""


def for_gpu(text: str) -> str:
    """Return LLVM code for this machine as code for a GPU."""
    text = re.sub(r'target datalayout = "[^"]*"', f'target datalayout = "{LAYOUT}"', text)
    text = re.sub(r'target triple = "[^"]*"', f'target triple = "{TRIPLE}"', text)
    text = re.sub(r'\ndeclare void @(llvm\.x86|meet_all|meet_block)[^\n]*', '', text)
    for name in OF_LIBM:
        text = re.sub(rf'@{name}\(', f'@llvm.{name}.f64(', text)
        text = re.sub(rf'@{name}f\(', f'@llvm.{name}.f32(', text)
    # environments of Python objects, which kernels do not read
    return re.sub(r'(@_ZN08NumbaEnv\w+ = )common global ptr null', r'\1internal global ptr null',
                  text)


def _place() -> list[str]:
    """Return code that finds the number of a thread, and of all threads of the launch."""
    lines = []
    for register in REGISTERS:
        lines += [f'%{register}32 = call i32 @llvm.nvvm.read.ptx.sreg.{register}.x()',
                  f'%{register} = zext i32 %{register}32 to i64']
    return [*lines, '%begin = mul i64 %ctaid, %ntid', '%worker = add i64 %begin, %tid',
            '%workers = mul i64 %nctaid, %ntid']


def _barrier(name: str, code: str, inputs: str = '', given: str = '') -> list[str]:
    return [f'define internal void @{name}(ptr %gate) alwaysinline convergent {{',
            f'call void asm sideeffect "{code}", "{inputs}~{{memory}}"({given}) convergent',
            'ret void', '}']


def entry(name: str, kinds: list[str], teams: list[int]) -> str:
    """
    Return LLVM code of the entry function and the barriers.

    Parameters
    ----------
    name : of the kernel's function
    kinds : LLVM types of its parameters, each of which takes SLOT bytes
    teams : parameters where a ``DeviceTeam`` begins, whose place each thread fills in

    """
    place: dict[int, str] = {}
    for at in teams:
        place[at], place[at + 1], place[at + 2] = '%worker', '%workers', '%ntid'
    values, loads = [], []
    for k, kind in enumerate(kinds):
        if k not in place:
            loads += [f'%p{k} = getelementptr [{len(kinds)} x i64], ptr %all, i32 0, i32 {k}',
                      f'%v{k} = load {kind}, ptr %p{k}']
        values.append(f'{kind} {place.get(k, f"%v{k}")}')
    barrier = BARRIER.replace('$', '$$').replace('GATE', '$0').replace('\n', '\\0A')
    return '\n'.join([
        *_barrier(MEET_ALL, barrier, 'l,', 'ptr %gate'),
        *_barrier(MEET_BLOCK, 'bar.sync 0; // meet_block'),
        *(f'declare i32 @llvm.nvvm.read.ptx.sreg.{s}.x()' for s in REGISTERS),
        f'define ptx_kernel void @{ENTRY}(ptr byval([{len(kinds)} x i64]) align {SLOT} %all) {{',
        '%result = alloca ptr', '%error = alloca ptr', *_place(), *loads,
        f'%status = call i32 @{name}(ptr %result, ptr %error, {", ".join(values)})',
        'ret void', '}'])


def ptx_of(text: str, name: str, kinds: list[str], teams: list[int], arch: str) -> str:
    """
    Return the PTX of a kernel.

    Parameters
    ----------
    text : LLVM code of the kernel and of all that it calls
    name, kinds, teams : as of ``entry``
    arch : of the card, such as 'sm_90'

    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    text = for_gpu(text) + '\n' + entry(name, kinds, teams)
    flags = ('"no-jump-tables"="true" '
             '"denormal-fp-math-f32"="preserve-sign,preserve-sign"')
    text = re.sub(r'\n(define [^\n]*?) \{', rf'\n\1 {flags} {{', text)
    module = llvm.parse_assembly(text)
    module.verify()
    for function in module.functions:
        if not function.is_declaration and function.name != ENTRY:
            function.linkage = 'internal'
            function.add_function_attribute('alwaysinline')
    machine = llvm.Target.from_triple(TRIPLE).create_target_machine(
        cpu=arch, features=VERSION, opt=3)
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization = options.slp_vectorization = False
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    ptx = re.sub(r'\.common [^\n]*\n', '', machine.emit_assembly(module))
    ptx = re.sub(r'(\.visible \.entry [^{]*\)\s*)\{',
                 lambda found: f'{found[1]}.maxntid {THREADS}, 1, 1\n{{', ptx, count=1)
    check_rounding(ptx)
    return ptx


def check_rounding(ptx: str) -> None:
    """Raise ValueError if an instruction might round unlike the CPU, or read other memory."""
    for line in ptx.splitlines():
        words = line.strip().split()
        if not words:
            continue
        name, *modes = words[0].split('.')
        kind = modes[-1].rstrip(';') if modes else ''
        if name in EXACT and kind in ('f32', 'f64') and (
                'rn' not in modes or kind == 'f32' and 'ftz' not in modes):
            raise ValueError(f'PTX that rounds unlike the CPU: {line.strip()}')
        if 'approx' in modes or name in ('mad', 'call') and kind in ('f32', 'f64') or (
                name.startswith('call')):
            raise ValueError(f'PTX that a CPU does not repeat: {line.strip()}')
