"""The sections of one run's page. Each says what is missing when the run does not yield it."""
