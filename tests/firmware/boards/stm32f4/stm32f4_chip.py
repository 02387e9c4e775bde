"""A model of the STM32F446's peripherals: what the reference manual allows, in which order, and what comes of it.

It does not know the firmware. Whatever the manual forbids is written into ``wrongs``.
"""

from stm32f4_clock import ClockAndFlash
from stm32f4_registers import ALTERNATE, NAMED, NUCLEO, Part

HTIF, TCIF, ALL_FLAGS = 1 << 4, 1 << 5, 0x3D
MOE, LOCK_BITS = 1 << 15, 3 << 8
FLAG_SHIFT = (0, 6, 16, 22)


def even(value: int) -> int:
    """Return 15 bits with the bit before them that makes the number of ones even."""
    return value | (value.bit_count() & 1) << 15


class AbsoluteSensor:
    """An AS5047: a frame answers the one before it; one that it does not understand sets the error bit until it is read."""

    ANGLE, DIAGNOSIS, ERRORS = 0x3FFF, 0x3FFC, 0x0001

    def __init__(self, angle: int) -> None:
        self.values = {self.ANGLE: angle, self.DIAGNOSIS: 0x0180, self.ERRORS: 0}
        self.answer = self.ANGLE
        self.asleep = 0  # frames until it answers
        self.spoiled = 0  # bits that are flipped on their way to it in the next frame
        self._ended = True

    def deselect(self) -> None:
        """Chip select is high: the frame is over."""
        self._ended = True

    def frame(self, frame: int) -> int:
        """Take a frame, give the answer to the one before it."""
        if self.asleep or not self._ended:
            self.asleep = max(0, self.asleep - 1)
            return 0
        frame, self.spoiled, self._ended = frame ^ self.spoiled, 0, False
        said = even(self.values[self.answer] & 0x3FFF | (0x4000 if self.values[self.ERRORS] else 0))
        if self.answer == self.ERRORS:
            self.values[self.ERRORS] = 0
        if even(frame & 0x7FFF) != frame or not frame & 0x4000 or frame & 0x3FFF not in self.values:
            self.values[self.ERRORS] = 4
        else:
            self.answer = frame & 0x3FFF
        return said


class Chip(ClockAndFlash):
    """Everything behind the processor's bus."""

    def __init__(self, part: Part = NUCLEO) -> None:
        super().__init__(part)
        self.inputs: dict[str, int] = {}
        self.levels: dict[int, int] = {}  # the converter's reading of each channel
        self.position = 0  # of the converter in its scan
        self.pended = False
        self.sensors: dict[str, AbsoluteSensor] = {}  # by the pin that selects them

    # pins

    def set_input(self, pin: str, level: int) -> None:
        """Put a level (0 or 1) to a pin; a pin nothing was put to follows its pull resistor."""
        self.inputs[pin] = level
        self.breaks()

    def _field(self, pin: str, register: str, bits: int) -> int:
        number = int(pin[2:])
        if register == "AFR":
            register, number = ("AFRL", number) if number < 8 else ("AFRH", number - 8)
        return self[f"GPIO{pin[1]}.{register}"] >> bits * number & (1 << bits) - 1

    def function(self, pin: str) -> str:
        """Return what a pin is connected to: input, output, analog, or the peripheral's signal."""
        mode = self._field(pin, "MODER", 2)
        if mode != 2:
            return ("input", "output", "", "analog")[mode]
        return ALTERNATE.get((pin, self._field(pin, "AFR", 4)), "nothing")

    def input(self, pin: str) -> int:
        """Return the level a digital input sees."""
        return self.inputs.get(pin, 1 if self._field(pin, "PUPDR", 2) == 1 else 0)

    def output(self, pin: str) -> float | None:
        """Return how much of the time an output is high, 0 to 1; None where it floats."""
        function = self.function(pin)
        if function == "output":
            return float(self[f"GPIO{pin[1]}.ODR"] >> int(pin[2:]) & 1)
        if "_CH" not in function:
            return None
        timer, channel = function.split("_CH")
        bdtr, shift = self[f"{timer}.BDTR"], 4 * (int(channel) - 1)
        if not bdtr & MOE:
            return 0.0 if bdtr >> 10 & 1 else None  # OSSI: the idle level, which CR2's OIS leave low
        if not self[f"{timer}.CCER"] >> shift & 1:
            return None
        return self._pwm(timer, int(channel))

    def _pwm(self, timer: str, channel: int) -> float:
        mode = self[f"{timer}.CCMR{1 + (channel - 1) // 2}"] >> 8 * ((channel - 1) % 2) & 0xFF
        if mode != 0x68:
            self.wrong(f"{timer} channel {channel}: not PWM mode 1 with preload")
        if not self[f"{timer}.CR1"] & 1:
            self.wrong(f"{timer} has its outputs on and stands still")
        return min(1.0, self[f"{timer}.CCR{channel}"] / self[f"{timer}.ARR"])

    def set_gpio_bsrr(self, name: str, value: int) -> None:
        """The lower half sets, the upper one resets."""
        odr = f"{name[:5]}.ODR"
        self[odr] = self[odr] & ~(value >> 16) | value & 0xFFFF
        for pin, sensor in self.sensors.items():
            if self.output(pin):
                sensor.deselect()

    def get_gpio_idr(self, name: str) -> int:
        """Return the levels of a port's pins."""
        return sum(self.input(f"P{name[4]}{i}") << i for i in range(16))

    # timers

    def breaks(self) -> None:
        """Let the break inputs do their work."""
        for timer, pin in self.part.breaks:
            bdtr = self[f"{timer}.BDTR"]
            if not bdtr >> 12 & 1 or self.function(pin) != f"{timer}_BKIN":
                continue
            if self.input(pin) == bdtr >> 13 & 1:
                self[f"{timer}.BDTR"] = bdtr & ~MOE
                self[f"{timer}.SR"] |= 1 << 7

    def set_tim_sr(self, name: str, value: int) -> None:
        """Flags are cleared by writing 0."""
        self[name] &= value
        self.breaks()

    def set_tim_bdtr(self, name: str, value: int) -> None:
        """LOCK is written once; at level 3 only MOE remains."""
        old = self[name]
        if old & LOCK_BITS and (old ^ value) & ~MOE:
            self.wrong(f"{name}: {value:#x} written over locked {old:#x}")
        self[name] = value
        self.breaks()

    # direct memory access

    def set_dma_flags(self, name: str, value: int) -> None:
        """LIFCR and HIFCR clear what they have 1 for."""
        status = f"{name[:5]}{'LISR' if 'LIFCR' in name else 'HISR'}"
        self[status] &= ~value

    def flags(self, dma: str, stream: int) -> tuple[str, int]:
        """Return the register and the shift of a stream's flags."""
        return f"{dma}.{'LISR' if stream < 4 else 'HISR'}", FLAG_SHIFT[stream % 4]

    def set_dma_stream(self, name: str, value: int) -> None:
        """A running stream can only be stopped; one with old flags must not be started."""
        dma, register = name.split(".")
        control = f"{dma}.{register[:2]}CR"
        running = self[control] & 1
        if running and not (name == control and value == self[control] & ~1) and not (name == control and value == 0):
            self.wrong(f"{name} written while the stream runs")
        if name == control and value & 1 and not running:
            status, shift = self.flags(dma, int(register[1]))
            if self[status] >> shift & ALL_FLAGS:
                self.wrong(f"{name}: started with old flags")
            self.length[f"{dma}.{register[:2]}"] = self[f"{dma}.{register[:2]}NDTR"]
        self[name] = value

    def transfer(self, stream: str, size: int, value: int | None) -> int:
        """Move one item from or to memory; return it."""
        dma, index = stream.split(".S")
        control, left, total = self[f"{stream}CR"], self[f"{stream}NDTR"], self.length[stream]
        if control >> 11 & 3 != size // 2 or control >> 13 & 3 != size // 2 or not control >> 10 & 1:
            self.wrong(f"{stream}: not items of {size} bytes one after the other")
        at = self[f"{stream}M0AR"] + size * (total - left)
        if not self.RAM[0] <= at < self.RAM[1]:
            self.wrong(f"{stream}: {at:#x} is not in RAM")
        if value is None:
            value = int.from_bytes(self.memory_read(at, size), "little")
        else:
            self.memory_write(at, value.to_bytes(size, "little"))
        status, shift = self.flags(dma, int(index))
        left -= 1
        if left == total // 2:
            self[status] |= HTIF << shift
        if left == 0:
            self[status] |= TCIF << shift
            left = total if control >> 8 & 1 else 0
            if not left:
                self[f"{stream}CR"] &= ~1
        self[f"{stream}NDTR"] = left
        return value

    # converter

    def sequence(self) -> list[int]:
        """Return the channels of one scan."""
        fields = [self[f"ADC1.SQR{3 - i // 6}"] >> 5 * (i % 6) & 31 for i in range(16)]
        return fields[: (self["ADC1.SQR1"] >> 20 & 15) + 1]

    def sampling(self, channel: int) -> int:
        """Return for how many of its clocks the converter samples a channel."""
        register, number = ("SMPR2", channel) if channel < 10 else ("SMPR1", channel - 10)
        return (3, 15, 28, 56, 84, 112, 144, 480)[self[f"ADC1.{register}"] >> 3 * number & 7]

    def set_adc_cr2(self, name: str, value: int) -> None:
        """Without ADON a scan under way is given up."""
        if not value & 1:
            self.position = 0
        self[name] = value

    def scans(self, count: int) -> None:
        """Let the PWM go through so many periods; each triggers a scan."""
        self.conversions(count * len(self.sequence()))

    def _triggered_by_tim8(self) -> bool:
        ready = self["TIM8.CR1"] & 1 and self["TIM8.CR2"] >> 4 & 7 == 7 and self["TIM8.CCMR2"] >> 12 & 7 == 6
        return bool(ready and 0 < self["TIM8.CCR4"] < self["TIM8.ARR"])

    def _triggered_by_tim4(self) -> bool:
        """TIM4 starts with TIM1, has its period, and its fourth channel rises once in it."""
        together = self["TIM1.CR1"] & 1 and self["TIM1.CR2"] >> 4 & 7 == 1 and self["TIM4.SMCR"] == 6
        period = self["TIM4.ARR"] + 1 == 2 * self["TIM1.ARR"] and self["TIM4.PSC"] == self["TIM1.PSC"]
        rises = self["TIM4.CCMR2"] >> 8 & 0x73 == 0x70 and self["TIM4.CCER"] == 1 << 12
        return bool(together and period and rises and 0 < self["TIM4.CCR4"] <= self["TIM4.ARR"])

    def conversions(self, count: int) -> None:
        """Let the converter do so many conversions of its scans, if it is triggered and somebody takes them."""
        stream, cr2 = "DMA2.S0", self["ADC1.CR2"]
        triggered = self._triggered_by_tim4() if self.part.trigger == 9 else self._triggered_by_tim8()
        listens = cr2 & 1 and cr2 >> 28 & 3 == 1 and cr2 >> 24 & 15 == self.part.trigger and self["ADC1.CR1"] >> 8 & 1
        listens = listens and not self["ADC1.SR"] >> 5 & 1  # an overrun stops the requests
        if not (triggered and listens and cr2 >> 8 & 3 == 3 and self[f"{stream}CR"] & 1):
            return
        if self[f"{stream}CR"] >> 25 & 7 != 0 or self[f"{stream}PAR"] != 0x4001204C:
            self.wrong("DMA2 stream 0 does not serve the converter")
        sequence = self.sequence()
        for _ in range(count):
            self.transfer(stream, 2, self.levels.get(sequence[self.position], 0))
            self.position = (self.position + 1) % len(sequence)

    # encoders

    def count(self, timer: str, edges: int) -> None:
        """Rotate the quadrature encoder at a timer."""
        first, second = (pin for (pin, _), what in ALTERNATE.items() if what.startswith(timer))
        ready = self.function(first) == f"{timer}_CH1" and self.function(second) == f"{timer}_CH2"
        inputs = self[f"{timer}.CCMR1"] & 0x303 == 0x101 and not self[f"{timer}.CCER"]
        if not (ready and inputs and self[f"{timer}.SMCR"] == 3 and self[f"{timer}.CR1"] == 1):
            self.wrong(f"{timer} does not count both lines of its encoder")
        self[f"{timer}.CNT"] = (self[f"{timer}.CNT"] + edges) % (self[f"{timer}.ARR"] + 1)

    def set_spi_dr(self, name: str, value: int) -> None:
        """A frame goes out to the one sensor that is selected, and its answer comes in."""
        spi = name[:4]
        # On; 16 bits, select by software, high; a quarter or less of the fastest clock; master; mode 1.
        if self[f"{spi}.CR1"] & 0xFC7 != 0xB45 or self.apb1()[0] / (2 << (self[f"{spi}.CR1"] >> 3 & 7)) > 10e6:
            self.wrong(f"{spi} is not set up for an AS5047")
        connected = {self.function(pin) for (pin, _), what in ALTERNATE.items() if what.startswith(spi)}
        if connected != {f"{spi}_SCK", f"{spi}_MISO", f"{spi}_MOSI"}:
            self.wrong(f"{spi} has not its pins")
        selected = [sensor for pin, sensor in self.sensors.items() if self.output(pin) == 0.0]
        if len(selected) > 1 or self[f"{spi}.SR"] & 1:
            self.wrong(f"{spi}: {len(selected)} sensors selected, or a frame not read")
        self[name] = selected[0].frame(value) if selected else 0  # the line is pulled low
        self[f"{spi}.SR"] |= 1

    def get_spi_dr(self, name: str) -> int:
        """Reading it clears RXNE."""
        self[f"{name[:4]}.SR"] &= ~1
        return self[name]

    # wire

    def receive(self, data: bytes) -> None:
        """Let bytes come in on the wire."""
        uart, stream, _ = self.part.uart
        ready = self[f"{uart}.CR1"] & 0x2004 == 0x2004 and self[f"{uart}.CR3"] & 0x40 and self[f"{stream}CR"] & 1
        if not ready or self[f"{stream}CR"] >> 25 & 7 != 4 or self[f"{stream}PAR"] != NAMED[f"{uart}.DR"]:
            self.wrong("nobody takes the bytes of the wire")
            return
        for byte in data:
            self.transfer(stream, 1, byte)

    def send(self, most: int) -> bytes:
        """Let the wire carry at most so many bytes away; return them."""
        (uart, _, stream), data = self.part.uart, bytearray()
        while self[f"{stream}CR"] & 1 and len(data) < most:
            if self[f"{uart}.CR1"] & 0x2008 != 0x2008 or not self[f"{uart}.CR3"] & 0x80:
                self.wrong(f"{uart} does not send")
            if self[f"{stream}CR"] >> 25 & 7 != 4 or self[f"{stream}CR"] >> 6 & 3 != 1:
                self.wrong(f"{stream} does not serve {uart}'s sender")
            if self[f"{stream}PAR"] != NAMED[f"{uart}.DR"]:
                self.wrong(f"{stream} does not write to {uart}")
            data.append(self.transfer(stream, 1, None))
        return bytes(data)

    def get_usart_dr(self, name: str) -> int:
        """Reading it after SR clears an overrun."""
        self[f"{self.part.uart[0]}.SR"] &= ~(1 << 3)
        return self[name]

    def set_scb_icsr(self, name: str, value: int) -> None:
        """PENDSVSET asks for PendSV."""
        self.pended = self.pended or bool(value >> 28 & 1)
