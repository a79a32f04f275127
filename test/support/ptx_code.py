"""
PTX as LLVM code for this machine: one function that runs a PTX thread up to its next stop.

A thread keeps its registers in a record, whose first word says where it goes on. It stops at the
barrier of all threads, and before each access to memory if ``step`` is True. Instructions that are
not known here raise an error.
"""

import re

import numpy as np

DONE, MET, TOUCHING, IN_BLOCK = range(4)
"""why a thread stops: at its end, at the barrier of all, at memory, at the barrier of its block"""
SPECIAL = [f'%{s}.{a}' for s in ('tid', 'ntid', 'ctaid', 'nctaid') for a in 'xyz'] + ['%laneid']
"""registers that tell a thread its place, in the order of the record ``special``"""
NUMBER = len(SPECIAL)
"""place of the thread's number in that record"""
WIDTH = {'pred': 1, 'b16': 16, 'b32': 32, 'b64': 64, 'f32': 32, 'f64': 64}
HEADER = 16
COMPARE = {'eq': 'oeq', 'ne': 'one', 'lt': 'olt', 'le': 'ole', 'gt': 'ogt', 'ge': 'oge',
           'equ': 'ueq', 'neu': 'une', 'ltu': 'ult', 'leu': 'ule', 'gtu': 'ugt', 'geu': 'uge',
           'num': 'ord', 'nan': 'uno'}
BINARY = {'add': {'f': 'fadd', '*': 'add'}, 'sub': {'f': 'fsub', '*': 'sub'},
          'mul': {'f': 'fmul', '*': 'mul'}, 'div': {'f': 'fdiv', 's': 'sdiv', '*': 'udiv'},
          'rem': {'s': 'srem', '*': 'urem'}, 'and': {'*': 'and'}, 'or': {'*': 'or'},
          'xor': {'*': 'xor'}, 'shl': {'*': 'shl'}, 'shr': {'s': 'ashr', '*': 'lshr'}}
"""instruction of LLVM by the kind of number"""
FUNCTIONS = {'sqrt': 'sqrt', 'abs': 'fabs', 'fma': 'fma'}
ROUND = {'rni': 'rint', 'rmi': 'floor', 'rpi': 'ceil', 'rzi': 'trunc'}
WITHOUT_EFFECT = ('ftz', 'rn', 'uni', 'lo', 'volatile', 'weak', 'relaxed', 'gpu', 'sys')
"""modes that all instructions of ours have, or that matter on a card only"""
HEAD = '\n'.join([
    f'@atomic = constant [{NUMBER + 1} x i32] [{", ".join(["i32 -2"] * (NUMBER + 1))}]', *(
    f'declare {kind} @llvm.{name}.{suffix}({", ".join([kind] * count)})'
    for kind, suffix in (('float', 'f32'), ('double', 'f64'))
    for name, count in (('fma', 3), ('sqrt', 1), ('fabs', 1), ('rint', 1), ('floor', 1),
                        ('ceil', 1), ('trunc', 1))),
    *(f'declare {kind} @llvm.ctpop.{kind}({kind})' for kind in ('i32', 'i64'))])


def kind_of(suffix: str) -> str:
    """Return the LLVM type of a PTX type."""
    return {'f32': 'float', 'f64': 'double', 'pred': 'i1'}.get(suffix, f'i{suffix[1:]}')


class Translation:
    """The LLVM code of one PTX kernel; ``size`` is that of a thread's record [bytes]."""

    def __init__(self, ptx: str, *, step: bool = False, barrier_too: bool = False):
        self.step = step
        body = ptx[ptx.index('.entry'):]
        self.name = re.search(r'\.entry (\w+)', body)[1]
        body = body[body.index('{') + 1:body.rindex('}')]
        body = re.sub(r'//(?! (meet_all|all met))[^\n]*', '', body)
        body = re.sub(r'\{ // meet_all(.*?)\} // all met',
                      self._barrier(barrier_too), body, flags=re.DOTALL)
        self.registers = {}
        size = 0
        for kind, stem, count in re.findall(r'\.reg \.(\w+)\s+(%\w+?)<(\d+)>;', body):
            for k in range(int(count)):
                self.registers[f'{stem}{k}'] = (WIDTH[kind], HEADER + 8 * size)
                size += 1
        self.local = HEADER + 16 * -(-size // 2)
        depot = re.search(r'\.local[^\n]*__local_depot\d+\[(\d+)\]', body)
        self.size = 16 * -(-(self.local + (int(depot[1]) if depot else 0)) // 16)
        body = re.sub(r'\.(reg|local|pragma)[^;]*;', '', body)
        self.out, self.count, self.stops, self.places = [], 0, 0, 0
        for statement in re.findall(r'\s*\$?\w+:|[^;:{}]*\{[^}]*\}[^;]*;|[^;:{}]+;', body):
            if statement.strip():
                self.statement(' '.join(statement.split()))

    @staticmethod
    def _barrier(whole: bool):
        """Return what stands in the place of a barrier: one stop, or its code with own labels."""
        numbers = iter(range(10**6))

        def replaced(match):
            mine = f'$M{next(numbers)}_'
            return match[1].replace('$L_', mine) if whole else 'meet_all;'
        return replaced

    def llvm(self) -> str:
        """Return the code; ``touch`` is called for each access to memory."""
        switch = ' '.join(f'i64 {k}, label %R_{k}' for k in range(1, self.stops + 1))
        return '\n'.join([
            HEAD, 'define i32 @run(ptr %regs, ptr %params, ptr %special, ptr %race) {',
            f'%local = getelementptr i8, ptr %regs, i64 {self.local}',
            '%pc = load i64, ptr %regs', f'switch i64 %pc, label %R_0 [ {switch} ]', 'R_0:',
            *self.out, 'unreachable', '}'])

    def value(self, code: str) -> str:
        """Write an instruction; return its result."""
        self.count += 1
        self.out.append(f'%t{self.count} = {code}')
        return f'%t{self.count}'

    def label(self) -> str:
        """Return a label that no branch has."""
        self.count += 1
        return f'U_{self.count}:'

    def get(self, operand: str, kind: str) -> str:
        """Return the value of an operand as an LLVM type."""
        if operand in SPECIAL:
            place = self.value(f'getelementptr i32, ptr %special, i32 {SPECIAL.index(operand)}')
            found = self.value(f'load i32, ptr {place}')
            return found if kind == 'i32' else self.value(f'zext i32 {found} to {kind}')
        if operand in ('%SP', '%SPL') or operand.startswith('__local_depot'):
            return self.value('ptrtoint ptr %local to i64')
        if operand.startswith('%'):
            width, at = self.registers[operand]
            place = self.value(f'getelementptr i8, ptr %regs, i64 {at}')
            return self.cast(self.value(f'load i{width}, ptr {place}'), width, kind)
        if operand == f'{self.name}_param_0':
            return self.value('ptrtoint ptr %params to i64')
        if operand.startswith(('0f', '0d')):
            return self.constant(operand, kind)
        if kind == 'i1':
            return {'0': 'false', '1': 'true', '-1': 'true'}[operand]
        return str(int(operand, 0))

    def cast(self, bits: str, width: int, kind: str) -> str:
        """Return bits as an LLVM type."""
        if kind == f'i{width}':
            return bits
        if kind in ('float', 'double'):
            return self.value(f'bitcast i{width} {bits} to {kind}')
        word = 'trunc' if int(kind[1:]) < width else 'zext'
        return self.value(f'{word} i{width} {bits} to {kind}')

    @staticmethod
    def constant(operand: str, kind: str) -> str:
        """Return a float that PTX writes as its bits."""
        bits = int(operand[2:], 16)
        if kind[0] == 'i':
            return str(bits)
        value = (np.array(bits, np.uint32).view(np.float32) if operand[1] == 'f'
                 else np.array(bits, np.uint64).view(np.float64))
        return f'0x{np.float64(value).view(np.uint64):016X}'

    def put(self, register: str, value: str, kind: str) -> None:
        """Write a value of an LLVM type to a register."""
        if register == '_':
            return
        width, at = self.registers[register]
        if kind in ('float', 'double'):
            value, kind = self.value(f'bitcast {kind} {value} to i{width}'), f'i{width}'
        if int(kind[1:]) != width:
            word = 'zext' if int(kind[1:]) < width else 'trunc'
            value = self.value(f'{word} {kind} {value} to i{width}')
        place = self.value(f'getelementptr i8, ptr %regs, i64 {at}')
        self.out.append(f'store i{width} {value}, ptr {place}')

    def stop(self, why: int) -> None:
        """Stop here, and go on here."""
        self.stops += 1
        self.out += [f'store i64 {self.stops}, ptr %regs', f'ret i32 {why}', f'R_{self.stops}:']

    def address(self, operand: str) -> str:
        """Return the pointer of [register + offset]."""
        base, _, offset = operand.strip('[] ').partition('+')
        start = self.get(base, 'i64')
        return self.value(f'inttoptr i64 {self.value(f"add i64 {start}, {offset or 0}")} to ptr')

    def statement(self, text: str) -> None:
        """Translate a label, or an instruction with its guard."""
        if text.endswith(':'):
            name = 'L_' + text[:-1].strip('$')
            self.out += [f'br label %{name}', f'{name}:']
            return
        text = text.rstrip('; ')
        guard = re.match(r'@(!?)(%\w+) (.*)', text)
        if guard:
            self.count += 1
            yes, no = f'Y_{self.count}', f'N_{self.count}'
            ways = (no, yes) if guard[1] else (yes, no)
            self.out += [f'br i1 {self.get(guard[2], "i1")}, label %{ways[0]}, label %{ways[1]}',
                         f'{yes}:']
            self.statement(guard[3])
            self.out += [f'br label %{no}', f'{no}:']
            return
        name, _, rest = text.partition(' ')
        word, *modes = name.split('.')
        modes = [mode for mode in modes if mode not in WITHOUT_EFFECT]
        operands = re.findall(r'\{[^}]*\}|\[[^\]]*\]|[^,\s]+', rest)
        if word in BINARY and not {'wide', 'hi'} & set(modes):
            self.binary(BINARY[word], modes, *operands)
        elif word in FUNCTIONS:
            self.function(FUNCTIONS[word], modes, *operands)
        else:
            getattr(self, 'op_' + word)(modes, *operands)

    def binary(self, codes, modes, d, a, b) -> None:
        kind = kind_of(modes[-1])
        word = codes.get(modes[-1][0]) or codes['*']
        self.put(d, self.value(f'{word} {kind} {self.get(a, kind)}, {self.get(b, kind)}'), kind)

    def function(self, name, modes, d, *operands) -> None:
        assert modes[-1][0] == 'f', 'of floats only'
        kind = kind_of(modes[-1])
        values = ', '.join(f'{kind} {self.get(v, kind)}' for v in operands)
        self.put(d, self.value(f'call {kind} @llvm.{name}.{modes[-1]}({values})'), kind)

    def op_ret(self, modes) -> None:
        self.out += ['store i64 -1, ptr %regs', f'ret i32 {DONE}', self.label()]

    def op_bra(self, modes, to) -> None:
        self.out += [f'br label %L_{to.strip("$")}', self.label()]

    def op_meet_all(self, modes) -> None:
        self.stop(MET)

    def op_bar(self, modes, _) -> None:
        self.stop(IN_BLOCK)

    def op_fence(self, modes) -> None:
        """Threads take turns: memory is consistent."""

    def op_atom(self, modes, d, place, a) -> None:
        assert 'add' in modes
        self.stop(TOUCHING)
        kind, at = kind_of(modes[-1]), self.address(place)
        if 'acq_rel' not in modes:    # any other access to the number is a race
            self.touch(at, int(kind[1:]) // 8, 'true', '@atomic')
        self.put(d, self.value(f'atomicrmw add ptr {at}, {kind} {self.get(a, kind)} seq_cst'),
                 kind)

    def op_red(self, modes, place, a) -> None:
        self.op_atom(modes, '_', place, a)

    def op_bfe(self, modes, d, a, first, count) -> None:
        kind = kind_of(modes[-1])
        assert modes[-1][0] == 'u'
        shifted = self.value(f'lshr {kind} {self.get(a, kind)}, {first}')
        self.put(d, self.value(f'and {kind} {shifted}, {2**int(count) - 1}'), kind)

    def op_popc(self, modes, d, a) -> None:
        kind = kind_of(modes[-1])
        count = self.value(f'call {kind} @llvm.ctpop.{kind}({kind} {self.get(a, kind)})')
        self.put(d, self.cast(count, int(kind[1:]), 'i32'), 'i32')

    def op_mov(self, modes, d, a) -> None:
        kind = kind_of(modes[0])
        self.put(d, self.get(a, kind), kind)

    def op_cvta(self, modes, d, a) -> None:
        self.put(d, self.get(a, 'i64'), 'i64')

    def wide(self, suffix, *operands) -> tuple:
        """Return operands in twice their width, and that type."""
        small, word = kind_of(suffix), 'sext' if suffix[0] == 's' else 'zext'
        large = f'i{2 * int(small[1:])}'
        return (*(self.value(f'{word} {small} {self.get(v, small)} to {large}')
                  for v in operands), large)

    def op_mul(self, modes, d, a, b) -> None:
        x, y, kind = self.wide(modes[1], a, b)
        product = self.value(f'mul {kind} {x}, {y}')
        if modes[0] == 'hi':
            half = int(kind[1:]) // 2
            product = self.value(f'lshr {kind} {product}, {half}')
            product, kind = self.value(f'trunc {kind} {product} to i{half}'), f'i{half}'
        self.put(d, product, kind)

    def op_mad(self, modes, d, a, b, c) -> None:
        if modes[0] == 'wide':
            x, y, kind = self.wide(modes[1], a, b)
        else:
            kind = kind_of(modes[-1])
            x, y = self.get(a, kind), self.get(b, kind)
        product = self.value(f'mul {kind} {x}, {y}')
        self.put(d, self.value(f'add {kind} {product}, {self.get(c, kind)}'), kind)

    def op_not(self, modes, d, a) -> None:
        kind = kind_of(modes[-1])
        ones = 'true' if kind == 'i1' else '-1'
        self.put(d, self.value(f'xor {kind} {self.get(a, kind)}, {ones}'), kind)

    def op_neg(self, modes, d, a) -> None:
        kind, value = kind_of(modes[-1]), self.get(a, kind_of(modes[-1]))
        self.put(d, self.value(f'fneg {kind} {value}' if modes[-1][0] == 'f' else
                               f'sub {kind} 0, {value}'), kind)

    def op_rcp(self, modes, d, a) -> None:
        kind = kind_of(modes[-1])
        self.put(d, self.value(f'fdiv {kind} 1.0, {self.get(a, kind)}'), kind)

    def op_max(self, modes, d, a, b) -> None:
        self.extreme(modes, d, a, b, 'gt')

    def op_min(self, modes, d, a, b) -> None:
        self.extreme(modes, d, a, b, 'lt')

    def extreme(self, modes, d, a, b, word) -> None:
        kind, sign = kind_of(modes[-1]), modes[-1][0]
        x, y = self.get(a, kind), self.get(b, kind)
        if sign == 'f':    # a number wins against what is none
            first = self.value(f'fcmp o{word} {kind} {x}, {y}')
            alone = self.value(f'fcmp uno {kind} {y}, {y}')
            first = self.value(f'or i1 {first}, {alone}')
        else:
            first = self.value(f'icmp {sign}{word} {kind} {x}, {y}')
        self.put(d, self.value(f'select i1 {first}, {kind} {x}, {kind} {y}'), kind)

    def op_selp(self, modes, d, a, b, p) -> None:
        kind = kind_of(modes[-1])
        self.put(d, self.value(f'select i1 {self.get(p, "i1")}, {kind} {self.get(a, kind)}, '
                               f'{kind} {self.get(b, kind)}'), kind)

    def op_setp(self, modes, d, a, b) -> None:
        word, suffix = modes[0], modes[-1]
        kind = kind_of(suffix)
        sign = '' if word in ('eq', 'ne') else 's' if suffix[0] == 's' else 'u'
        code = f'fcmp {COMPARE[word]}' if suffix[0] == 'f' else f'icmp {sign}{word}'
        self.put(d, self.value(f'{code} {kind} {self.get(a, kind)}, {self.get(b, kind)}'), 'i1')

    def op_cvt(self, modes, d, a) -> None:
        how = modes.pop(0) if modes[0] in ROUND else ''
        (to, of), value = modes, self.get(a, kind_of(modes[1]))
        kind, source = kind_of(to), kind_of(of)
        if to[0] == of[0] == 'f' and kind == source:
            value = self.value(f'call {kind} @llvm.{ROUND[how]}.{to}({kind} {value})')
        elif to[0] == of[0] == 'f':
            value = self.value(f'{"fpext" if kind == "double" else "fptrunc"} {source} {value} '
                               f'to {kind}')
        elif to[0] == 'f':
            word = 'sitofp' if of[0] == 's' else 'uitofp'
            value = self.value(f'{word} {source} {value} to {kind}')
        elif of[0] == 'f':
            if how != 'rzi':
                value = self.value(f'call {source} @llvm.{ROUND[how]}.{of}({source} {value})')
            word = 'fptosi' if to[0] == 's' else 'fptoui'
            value = self.value(f'{word} {source} {value} to {kind}')
        elif kind != source:
            longer = 'sext' if of[0] == 's' else 'zext'
            word = longer if int(kind[1:]) > int(source[1:]) else 'trunc'
            value = self.value(f'{word} {source} {value} to {kind}')
        self.put(d, value, kind)

    def op_ld(self, modes, d, place) -> None:
        kind = kind_of(modes[-1])
        if modes[0] == 'acquire':
            self.stop(TOUCHING)
        if modes[0] in ('param', 'acquire'):
            self.read(d, self.address(place), kind)
        else:
            self.memory(modes[0], place, d.strip('{}').split(','), kind, self.read)

    def op_st(self, modes, place, a) -> None:
        self.memory(modes[0], place, a.strip('{}').split(','), kind_of(modes[-1]), self.write)

    def memory(self, space, place, values, kind, act) -> None:
        """Read or write some numbers, one after another; memory of all threads is watched."""
        if self.step and space != 'local':
            self.stop(TOUCHING)
        start = self.address(place)
        size = {'float': 4, 'double': 8}.get(kind) or int(kind[1:]) // 8
        for k, each in enumerate(values):
            at = self.value(f'getelementptr i8, ptr {start}, i64 {k * size}') if k else start
            if space != 'local':
                self.touch(at, size, 'true' if act == self.write else 'false')
            act(each.strip(), at, kind)

    def touch(self, at, size, writes, special='%special') -> None:
        """Tell that this thread, or with ``@atomic`` any, reads or writes some bytes."""
        self.places += 1
        self.out.append(f'call void @touch(ptr {at}, i64 {size}, i1 {writes}, '
                        f'i64 {self.places}, ptr {special}, ptr %race)')

    def read(self, register, at, kind) -> None:
        self.put(register, self.value(f'load {kind}, ptr {at}, align 1'), kind)

    def write(self, value, at, kind) -> None:
        self.out.append(f'store {kind} {self.get(value, kind)}, ptr {at}, align 1')
