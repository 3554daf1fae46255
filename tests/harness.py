"""What every run of pytest inside a test is started with."""

RUN = ("-p", "no:dash", "-p", "no:cacheprovider")
