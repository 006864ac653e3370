"""The ground side: flight log in, clouds, trajectories and figures about them out."""

from groundproc.machine import kernelcache, system

system.choose_threads_of_blas()
kernelcache.choose()
