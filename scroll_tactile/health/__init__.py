"""Whether the sensor is still the one that learned: its channels in each touch, and a bet against exchangeability."""
