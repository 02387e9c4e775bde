"""``armsight check``: evaluate an arm by ISO 9283 and ISO 230-4, or plan the motions of such a test."""

#: Test -> how many cycles it has unless asked otherwise, and how many ISO 9283 requires.
CYCLES, REQUIRED_CYCLES = {"poses": 30, "wide": 1, "line": 10, "circle": 3}, {"poses": 30, "line": 10}
#: The first pose must have been attained this many times for its drift; half: scatter passes for drift, double: tests of 10
#: to 19 cycles show none.
DRIFT_CYCLES = 10
