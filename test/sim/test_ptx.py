"""The emulator's instructions against NumPy, and what is checked of PTX before a card gets it."""

import numpy as np
import pytest

from support.ptx_code import Translation
from support.ptx_emulator import EmulatedCard, EmulatedKernel
from xpbd_ros.sim.backend.device_memory import DeviceMemory
from xpbd_ros.sim.backend.nvptx import check_rounding

KERNEL = """
.visible .entry run(
    .param .align 8 .b8 run_param_0[16]
)
{{
    .reg .pred %p<4>;
    .reg .b32 %r<9>;
    .reg .b64 %rd<9>;
    ld.param.b64 %rd1, [run_param_0];
    mov.u32 %r8, %tid.x;
    {code}
    ret;
}}
"""
FLOATS = np.array([1.5, -2.25, 0.1, 3e7, -0.0, np.inf, 1e-20, 7.0])
INTEGERS = np.array([3, -7, 2**31 - 1, -2**31, 0, 12345678, -1, 9], np.int32)
FLOAT_CODES = {
    'add.rn.{k}': lambda a, b: a + b,
    'sub.rn.{k}': lambda a, b: a - b,
    'mul.rn.{k}': lambda a, b: a * b,
    'div.rn.{k}': lambda a, b: a / b,
    'max.{k}': np.fmax,
    'min.{k}': np.fmin,
}
INTEGER_CODES = {
    'add.s32': lambda a, b: a + b,
    'sub.s32': lambda a, b: a - b,
    'mul.lo.s32': lambda a, b: a * b,
    'mul.hi.s32': lambda a, b: (a.astype(np.int64) * b >> 32).astype(np.int32),
    'mul.hi.u32': lambda a, b: (a.view(np.uint32).astype(np.uint64) * b.view(np.uint32)
                                >> np.uint64(32)).astype(np.uint32).view(np.int32),
    'and.b32': lambda a, b: a & b,
    'or.b32': lambda a, b: a | b,
    'xor.b32': lambda a, b: a ^ b,
    'max.s32': np.maximum,
    'min.u32': lambda a, b: np.minimum(a.view(np.uint32), b.view(np.uint32)).view(np.int32),
}
UNARY = {
    'neg.{k}': np.negative,
    'abs.{k}': np.abs,
    'sqrt.rn.{k}': lambda a: np.sqrt(a),
    'rcp.rn.{k}': lambda a: 1.0 / a,
    'cvt.rni.{k}.{k}': np.rint,
}


def run(code: str, *arrays, grid=1, block=1, **options):
    """Run code whose first parameter is the address of arrays, one after another."""
    size = sum(array.nbytes for array in arrays)
    card = EmulatedCard(**options)
    address = card.allocate(max(size, 8))
    at = address
    for array in arrays:
        card.put(at, array)
        at += array.nbytes
    kernel = EmulatedKernel(KERNEL.format(code=code))
    card.launch(kernel, np.array([address, 0]), grid, block)
    for array in reversed(arrays):
        at -= array.nbytes
        card.get(at, array)
    return card


def compute(word: str, register: str, bits: int, *inputs):
    """Return what an instruction makes of arrays of numbers, one after another."""
    suffix, size = f'b{bits}', bits // 8
    out = np.zeros_like(inputs[0])
    for n in range(len(out)):
        values = [array[n:n + 1].copy() for array in inputs]
        lines = [f'ld.global.{suffix} {register}{k + 1}, [%rd1+{size * k}];'
                 if register != '%rd' else
                 f'ld.global.{suffix} {register}{k + 2}, [%rd1+{size * k}];'
                 for k in range(len(values))]
        first = 2 if register == '%rd' else 1
        operands = ', '.join(f'{register}{k + first}' for k in range(len(values)))
        result = np.zeros(1, out.dtype)
        lines += [f'{word} {register}7, {operands};',
                  f'st.global.{suffix} [%rd1+{size * len(values)}], {register}7;']
        run('\n'.join(lines), *values, result)
        out[n] = result[0]
    return out


@pytest.mark.parametrize('bits', [32, 64])
@pytest.mark.parametrize('word', [*FLOAT_CODES, *UNARY])
@pytest.mark.filterwarnings('ignore:.*(divide|invalid).*:RuntimeWarning')
def test_instructions_of_floats(word, bits):
    a = FLOATS.astype(f'f{bits // 8}')
    inputs = (a, a[::-1].copy()) if word in FLOAT_CODES else (a,)
    expected = {**FLOAT_CODES, **UNARY}[word](*inputs)
    found = compute(word.format(k=f'f{bits}'), '%r' if bits == 32 else '%rd', bits, *inputs)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize('word', INTEGER_CODES)
def test_instructions_of_whole_numbers(word):
    inputs = INTEGERS, INTEGERS[::-1].copy()
    with np.errstate(over='ignore'):
        np.testing.assert_array_equal(compute(word, '%r', 32, *inputs),
                                      INTEGER_CODES[word](*inputs))


def test_bits_of_a_whole_number():
    code = """ld.global.b32 %r1, [%rd1];
    bfe.u32 %r2, %r1, 5, 7;
    st.global.b32 [%rd1], %r2;"""
    found = np.array([0b1010_1100_1110_1010], np.int32)
    run(code, found)
    assert found[0] == 0b1100111


def test_fma_rounds_once():
    a, b, c = (np.array([v]) for v in (1.0 + 2.0**-30, 1.0 - 2.0**-30, -1.0))
    assert compute('fma.rn.f64', '%rd', 64, a, b, c)[0] == -2.0**-60
    assert (a * b + c)[0] == 0.0


def test_denormal_numbers_count_as_zero():
    a = np.array([1e-39], np.float32)
    assert compute('add.rn.ftz.f32', '%r', 32, a, a)[0] == 0.0


def test_an_unknown_instruction_is_an_error():
    with pytest.raises(AttributeError, match='op_shfl'):
        Translation(KERNEL.format(code='shfl.sync.b32 %r1, %r2, %r3, %r4, %r5;'))


ONE_WORD = 'st.global.b32 [%rd1], %r8;'
OWN_WORD = """mul.wide.u32 %rd2, %r8, 4;
    add.s64 %rd3, %rd1, %rd2;
    st.global.b32 [%rd3], %r8;"""
ADD = 'red.relaxed.sys.global.add.u32 [%rd1], %r8;'
MEET = '{ // meet_all\nbar.sync 0;\n} // all met\n'
NEIGHBOUR = """xor.b32 %r2, %r8, 1;
    mul.wide.u32 %rd4, %r2, 4;
    add.s64 %rd5, %rd1, %rd4;
    ld.global.b32 %r3, [%rd5];
    st.global.b32 [%rd3+16], %r3;"""


def test_races_are_counted_and_only_races():
    assert run(ONE_WORD, np.zeros(4, np.int32), block=4).races > 0
    assert run(OWN_WORD, np.zeros(4, np.int32), block=4).races == 0


@pytest.mark.parametrize('order', ['in turn', 'backwards', 'shuffled', 'random'])
def test_what_a_neighbour_wrote_is_read_behind_the_barrier(order):
    found = np.zeros(8, np.int32)
    card = run(OWN_WORD + MEET + NEIGHBOUR, found, block=4, order=order)
    assert card.races == 0 and card.barriers == 1
    assert found.tolist() == [0, 1, 2, 3, 1, 0, 3, 2]
    assert run(OWN_WORD + NEIGHBOUR, np.zeros(8, np.int32), block=4, order=order).races > 0


@pytest.mark.parametrize('order', ['in turn', 'random'])
def test_additions_side_by_side_are_no_race_but_a_look_at_the_sum_is(order):
    found = np.array([7, 0, 0, 0], np.int32)
    assert run(ADD, found, block=4, order=order).races == 0
    assert found[0] == 7 + 6
    read = 'ld.global.b32 %r3, [%rd1];'
    assert run(ADD + MEET + read, found, block=4, order=order).races == 0
    assert run(ADD + read, found, block=4, order=order).races > 0
    assert run(ADD + ONE_WORD, found, block=4, order=order).races > 0


def test_accesses_outside_of_the_memory_are_counted():
    code = 'ld.global.b32 %r1, [%rd1+8];'
    assert run(code, np.zeros(3, np.int32)).astray == 0
    assert run(code, np.zeros(2, np.int32)).astray == 1


@pytest.mark.parametrize('line', [
    'add.rn.f32 %r1, %r2, %r3;', 'mul.f64 %rd1, %rd2, %rd3;', 'sqrt.approx.ftz.f32 %r1, %r2;',
    'fma.rz.f64 %rd1, %rd2, %rd3, %rd4;', 'call.uni (retval0), sin, (param0);'])
def test_code_that_rounds_otherwise_is_refused(line):
    check_rounding('add.rn.ftz.f32 %r1, %r2, %r3;\nadd.rn.f64 %rd1, %rd2, %rd3;\n'
                   'mul.wide.u32 %rd2, %r8, 4;\nadd.s64 %rd1, %rd2, %rd3;')
    with pytest.raises(ValueError, match='PTX that'):
        check_rounding(line)


def test_only_what_the_host_changed_replaces_what_the_card_has():
    """The host's x is older than the card's: its change of one element keeps the others."""
    card, x, y = EmulatedCard(), np.arange(6.0), np.arange(3, dtype=np.int32)
    memory = DeviceMemory(card, [x, y])
    memory.remember([x, y])
    card.put(memory.address(x), 10.0 * np.arange(6.0))    # as a kernel would
    x[2] = 0.5
    memory.upload([x, y])
    memory.get([x])
    np.testing.assert_array_equal(x, [0.0, 10.0, 0.5, 30.0, 40.0, 50.0])
    np.testing.assert_array_equal(y, [0, 1, 2])
    assert memory.address(x[2:]) == memory.address(x) + 16
