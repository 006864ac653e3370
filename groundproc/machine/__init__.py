"""What the ground tool wants of the machine it runs on: cores, locks, a terminal, a browser, a place for compiled kernels.

Map
---
system        what systems do differently: locks, processes, links, memory given back
stopping      Ctrl-C, SIGTERM and SIGXCPU as exceptions
readahead     the next piece made by a thread while the last one is used
screen        what a command writes to a terminal, made harmless
loopback      pages for a browser on this machine alone
kernelcache   where compiled kernels are kept
"""
