"""Text to CasADi, a folder a stage; a module imports only what stands before it.

errors words digits  what all are written in; timings: how long it takes
files                       what is read and written, whoever named it
multiples                   common multiples and divisors of exact times
weights                     exact sums of the decimals by which peers weigh one another
source                      nodes, yaml_faults, compose: YAML to nodes; reading: typed values out of nodes
language                    expression, parsing, grammar: text to trees; evaluation: trees to formulas and
                            values
                            dimensions, units, unit_text, unit_check
                            vectors; values, tables, recordings: numbers of a scene, and in CSV files
                            probes: of what ping and irtt wrote
components                  component, parts, declarations, component_check, definitions, library
scene                       named_numbers, timebase, instances, graphs, links, groups,
                            studies: a section each; oddities: warnings; scene: all of them
equations                   connections: where connectors meet; flatten: equations and crossings
                            clocks: what ticks together; terms, zero_test: SymPy
                            reductions: what is heard of the others; derivatives, solution: data types
                            matching, elimination, blocks: solving; aliases, index: derivatives and states
                            structure
functions                   casadi_writer: what is written; exchange: what lies beside;
                            functions
compiled, plain             the compiled model; operations of its functions
interpolation               tables over time in these functions
crowd                       how many peers there are, and how many each hears
store                       the compiled model on disk
seal, cache                 what this user's apc wrote; whether it still is what its texts compile to
pipeline                    the stages one after another
view                        schema; catalogue: the library; diagram; stages, listing
"""
