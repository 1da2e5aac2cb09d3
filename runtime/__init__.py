"""CasADi to answers, a folder a subject.

frame (one peer over a frame) → network (packets that get lost or come late) → eigen (all peers) and large
(very many) → analysis → vary (many values of some parameters) → sweep, simulate, region → answers → bench.
Each imports only what comes before it.
"""
