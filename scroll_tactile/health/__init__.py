"""Whether the sensor is still the one that learned: numbers of a touch's channels, and a bet against exchangeability."""
