"""The ground side: flight log in, clouds, trajectories and figures about them out."""
