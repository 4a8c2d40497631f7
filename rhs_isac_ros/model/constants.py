"""Constants of nature, and conversions between units."""

import math

SPEED_OF_LIGHT_MPS = 299_792_458.0
# Nepers per decibel of an amplitude, and of a power.
NEPERS_PER_DB = math.log(10) / 20
POWER_NEPERS_PER_DB = math.log(10) / 10
