"""The ground side: flight log in, clouds, trajectories and figures about them out."""

from groundproc.machine import kernelcache

kernelcache.choose()
