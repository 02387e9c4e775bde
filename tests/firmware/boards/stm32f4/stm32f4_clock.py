"""The part of the chip model that must be right before anything else runs: clocks, supply, flash memory, watchdog."""

from collections.abc import Callable

from stm32f4_registers import ADDRESS, NUCLEO, PERIPHERALS, RESET, Part

READY_AFTER = 3  # reads until a ready flag follows
KEYS = (0x45670123, 0xCDEF89AB)
SECTORS = {1: (0x08004000, 0x4000), 2: (0x08008000, 0x4000)}


class ClockAndFlash:
    """Registers by name (``chip["RCC.CR"]``), every write in ``writes``, everything the manual forbids in ``wrongs``."""

    RAM = (0x20000000, 0x20020000)

    def __init__(self, part: Part = NUCLEO) -> None:
        self.part = part
        self.values = {name: RESET.get(name, 0) for name in ADDRESS.values()}
        self.writes: list[tuple[str, int]] = []
        self.wrongs: list[str] = []
        self.length: dict[str, int] = {}
        self.external_clock = True
        self.memory_read: Callable[[int, int], bytes]
        self.memory_write: Callable[[int, bytes], None]
        self._waits: dict[str, int] = {}
        self._keys: list[int] = []
        self._watchdog_open = False
        self.fed = 0

    def __getitem__(self, name: str) -> int:
        return self.values[name]

    def __setitem__(self, name: str, value: int) -> None:
        self.values[name] = value & 0xFFFFFFFF

    def wrong(self, text: str) -> None:
        """Write down what the manual forbids."""
        self.wrongs.append(text)

    def written(self, name: str) -> list[int]:
        """Return all values written to a register."""
        return [value for register, value in self.writes if register == name]

    def first(self, name: str, mask: int = 0xFFFFFFFF) -> int:
        """Return the index among all writes of the first one that set any bit of ``mask`` in a register."""
        return next(i for i, (register, value) in enumerate(self.writes) if register == name and value & mask)

    # bus

    def _handler(self, access: str, name: str) -> Callable | None:
        peripheral, register = name.lower().split(".")
        family = "".join(c for c in peripheral if not c.isdigit())
        if family.startswith("gpio"):
            family = "gpio"
        if family == "dma":
            register = "flags" if register.endswith("ifcr") else "stream" if register.startswith("s") else register
        for prefix in (peripheral, family):
            if found := getattr(self, f"{access}_{prefix}_{register}", None):
                return found
        return None

    def clocked(self, name: str) -> bool:
        """Return whether a register's peripheral has its clock."""
        peripheral = name.split(".")[0]
        if peripheral in self.part.absent:
            return False
        gate = PERIPHERALS[peripheral][2]
        return gate is None or bool(self[f"RCC.{gate[0]}"] >> gate[1] & 1)

    def read(self, address: int, size: int) -> int:
        """Read a register."""
        name = ADDRESS.get(address)
        if name is None or size != 4 or not self.clocked(name):
            self.wrong(f"read of {size} bytes at {address:#x} ({name})")
            return 0
        handler = self._handler("get", name)
        return handler(name) if handler else self[name]

    def write(self, address: int, size: int, value: int) -> None:
        """Write a register."""
        name = ADDRESS.get(address)
        if name is None or size != 4 or not self.clocked(name):
            self.wrong(f"{value:#x} written in {size} bytes at {address:#x} ({name})")
            return
        self.writes.append((name, value))
        handler = self._handler("set", name)
        if handler:
            handler(name, value)
        else:
            self[name] = value

    def _late(self, name: str, condition: bool) -> bool:
        """Follow a condition after a few reads."""
        if not condition:
            self._waits[name] = 0
            return False
        self._waits[name] = self._waits.get(name, 0) + 1
        return self._waits[name] > READY_AFTER

    # clock tree, Hz

    def sysclk(self) -> float:
        """Return the system clock."""
        if self["RCC.CFGR"] >> 2 & 3 != 2:
            return 16e6
        factors = self["RCC.PLLCFGR"]
        source = self.part.hse_hz if factors >> 22 & 1 else 16e6
        return source / (factors & 63) * (factors >> 6 & 511) / (2 + 2 * (factors >> 16 & 3))

    def _bus(self, shift: int) -> tuple[float, float]:
        prescale = self["RCC.CFGR"] >> shift & 7
        divider = 1 << (prescale - 3) if prescale >= 4 else 1
        return self.sysclk() / divider, self.sysclk() / divider * (1 if divider == 1 else 2)

    def _buses(self) -> tuple[float, float, float]:
        return self.sysclk(), self.apb1()[0], self.apb2()[0]

    def apb1(self) -> tuple[float, float]:
        """Return the clocks of the slow bus and of its timers."""
        return self._bus(10)

    def apb2(self) -> tuple[float, float]:
        """Return the clocks of the fast bus and of its timers."""
        return self._bus(13)

    def get_rcc_cr(self, name: str) -> int:
        """Oscillators and PLL are ready some time after they are on."""
        value = self[name] & ~(1 << 17 | 1 << 25)
        value |= self._late("HSE", bool(value >> 16 & 1) and self.external_clock) << 17
        value |= self._late("PLL", bool(value >> 24 & 1)) << 25
        self[name] = value
        return value

    def set_rcc_cr(self, name: str, value: int) -> None:
        """The bypass is chosen before the oscillator is on; the PLL's factors before the PLL is."""
        old = self[name]
        if (old ^ value) >> 18 & 1 and old >> 16 & 1:
            self.wrong("HSEBYP changed while HSE is on")
        if value >> 18 & 1 and self.part.crystal:
            self.wrong("a crystal is bypassed")
        if value >> 24 & 1 and not old >> 24 & 1:
            factors = self["RCC.PLLCFGR"]
            source = self.part.hse_hz if factors >> 22 & 1 else 16e6
            vco_in = source / (factors & 63)
            if factors >> 22 & 1 and not old >> 17 & 1:
                self.wrong("the PLL's source is not ready")
            if not (1e6 <= vco_in <= 2e6 and 100e6 <= vco_in * (factors >> 6 & 511) <= 432e6):
                self.wrong(f"PLL factors {factors:#x} out of range")
            if (factors >> 24 & 15) < 2 or (factors >> 28 & 7) < 2:
                self.wrong(f"PLLQ or PLLR of {factors:#x} out of range")
        if value >> 19 & 1 and not old >> 17 & 1:
            self.wrong("clock security without the external clock")
        self[name] = value

    def set_rcc_pllcfgr(self, name: str, value: int) -> None:
        """Only while the PLL is off."""
        if self["RCC.CR"] >> 24 & 1:
            self.wrong("PLLCFGR written while the PLL is on")
        self[name] = value

    def set_rcc_cfgr(self, name: str, value: int) -> None:
        """Before the switch to the PLL: it is locked, over-drive on, the flash memory slow enough, the buses too."""
        self[name] = value & ~(3 << 2) | self[name] & 3 << 2
        if value & 3 == 2 and self[name] >> 2 & 3 != 2:
            if not self["RCC.CR"] >> 25 & 1:
                self.wrong("switched to a PLL that is not locked")
            if self.part.over_drive and not self["PWR.CSR"] >> 17 & 1:
                self.wrong("switched beyond 168 MHz without over-drive")
            self[name] = value & ~(3 << 2) | 2 << 2
            if self["PWR.CR"] >> 14 & 3 != 3:
                self.wrong("switched to a fast clock without the regulator's scale 1")
            if self.sysclk() > self.part.flash_hz[min(self["FLASH.ACR"] & 15, len(self.part.flash_hz) - 1)]:
                self.wrong("switched to a clock too fast for the flash memory's wait states")
            if any(hz > most for hz, most in zip(self._buses(), self.part.most_hz, strict=True)):
                self.wrong("a bus runs too fast")

    def _enable(self, name: str, value: int) -> None:
        switching = self["PWR.CR"] >> 17 & 1 and not self["PWR.CSR"] >> 17 & 1
        before = not self["PWR.CSR"] >> 17 & 1 and value & ~(1 << 28)
        if self.part.over_drive and (switching or before):
            self.wrong(f"{name}: a peripheral gets its clock before over-drive is on")
        self[name] = value

    set_rcc_ahb1enr = set_rcc_apb1enr = set_rcc_apb2enr = _enable

    def set_rcc_csr(self, name: str, value: int) -> None:
        """RMVF clears the reasons of the last reset."""
        self[name] = self[name] & 0x00FFFFFF if value >> 24 & 1 else value

    def get_pwr_csr(self, name: str) -> int:
        """Over-drive becomes ready, then switched, some time after each is asked for."""
        control = self["PWR.CR"]
        ready = self._late("OD", bool(control >> 16 & 1))
        self[name] = self[name] & 4 | ready << 16 | self._late("ODSW", ready and bool(control >> 17 & 1)) << 17
        return self[name]

    def set_pwr_cr(self, name: str, value: int) -> None:
        """The switch to over-drive waits for over-drive."""
        if value >> 16 & 3 and not self.part.over_drive:
            self.wrong("over-drive, which it does not have")
        if value >> 17 & 1 and not self["PWR.CSR"] >> 16 & 1:
            self.wrong("ODSWEN before ODRDY")
        self[name] = value

    # flash memory

    def set_flash_keyr(self, _: str, value: int) -> None:
        """Two keys unlock CR."""
        self._keys.append(value)
        if tuple(self._keys[-2:]) == KEYS:
            self["FLASH.CR"] &= ~(1 << 31)

    def get_flash_sr(self, name: str) -> int:
        """Busy for a few reads after each operation."""
        busy = bool(self[name] >> 16 & 1)
        if busy and self._late("BSY", True):
            self[name] &= ~(1 << 16)
            self._waits["BSY"] = 0
        return self[name]

    def set_flash_sr(self, name: str, value: int) -> None:
        """Flags are cleared by writing 1."""
        self[name] &= ~value | 1 << 16

    def set_flash_cr(self, name: str, value: int) -> None:
        """Erase a sector when STRT comes."""
        if self[name] >> 31 & 1:
            self.wrong("FLASH_CR written while it is locked")
        if self["FLASH.SR"] >> 16 & 1:
            self.wrong("FLASH_CR written while the memory is busy")
        if value >> 16 & 1:
            sector = value >> 3 & 15
            if value & 7 != 2 or sector not in SECTORS:
                self.wrong(f"FLASH_CR {value:#x} erases something else than a configuration's sector")
            else:
                at, length = SECTORS[sector]
                self.memory_write(at, b"\xff" * length)
                self["FLASH.SR"] |= 1 << 16
        self[name] = value & ~(1 << 16)

    def program(self, at: int, size: int, value: int) -> None:
        """The processor writes into flash memory."""
        sector = next((s for s, (base, length) in SECTORS.items() if base <= at < base + length), None)
        if self["FLASH.CR"] & 0x80000307 != 0x201 or size != 4 or sector is None or at % 4:
            self.wrong(f"{value:#x} written into flash memory at {at:#x}")
        if self["FLASH.SR"] >> 16 & 1:
            self.wrong("flash memory written while it is busy")
        if self.memory_read(at, 4) != b"\xff" * 4:
            self.wrong(f"flash memory at {at:#x} written without an erase")
        self["FLASH.SR"] |= 1 << 16

    # watchdog

    def set_iwdg_kr(self, _: str, value: int) -> None:
        """Keys: start, unlock, feed. Any but unlock locks."""
        self._watchdog_open = value == 0x5555
        self.fed += value == 0xAAAA
        if value == 0xAAAA and self["IWDG.SR"]:
            self.wrong("the watchdog is fed with its old time: the new one is still on its way")
        if value not in (0x5555, 0xAAAA, 0xCCCC):
            self.wrong(f"watchdog key {value:#x}")

    def _watchdog_time(self, name: str, value: int) -> None:
        if not self._watchdog_open or self["IWDG.SR"] >> (name == "IWDG.RLR") & 1:
            self.wrong(f"{name} written while it does not listen")
        self[name] = value
        self["IWDG.SR"] |= 2 if name == "IWDG.RLR" else 1

    set_iwdg_pr = set_iwdg_rlr = _watchdog_time

    def get_iwdg_sr(self, name: str) -> int:
        """A change takes some time to reach the slow side."""
        value = self[name]
        if self._late("IWDG", value != 0):
            self[name] = 0
            self._waits["IWDG"] = 0
        return value

    def watchdog_ms(self) -> float:
        """Return how long the watchdog waits at its nominal 32 kHz, ms."""
        return (self["IWDG.RLR"] + 1) * (4 << self["IWDG.PR"]) / 32.0
