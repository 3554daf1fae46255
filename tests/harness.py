"""What runs of pytest inside a test are started with, and what is the same in all of them."""

RUN = ("-p", "no:dash", "-p", "no:cacheprovider")

#: Contract items of tests/tiny.py's perfect method: those that pass, and those that do not apply
#: or find what is not demanded.
KEPT, NOT_DEMANDED = 17, 6
