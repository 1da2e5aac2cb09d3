"""Compilation of a topology in YAML to CasADi functions, one folder for each stage.

A module imports only modules listed before it.

Shared      `errors`, `wording`, `number_parsing`; `timings` of a command; `files`: reading and writing;
            `multiples` of exact times; `disjoint_sets` of names; `weights` of peers; `message_catalogue`
`source`    `nodes`, `yaml_errors`, `compose`, `source`: YAML to nodes; `reading`: nodes to typed values
`language`  `expression`, `parsing`, `grammar`: text to trees; `constants`; `evaluation`: trees to numbers;
            `dimensions`, `units`, `unit_text`, `unit_check`; `vectors`; `values`: numbers of a topology;
            `csv_tables`; `ping_recordings`, `recordings`: measured delays and time tables
`components`
            `component`: data types; `declarations`, `parts`, `component_check`, `definitions`,
            `component_library`
`topology`  `topology_parameters`, `timebase`, `instances`, `redeclarations`, `graphs`,
            `channels`, `links`, `groups`, `studies`: one section each; `topology_warnings`: warnings;
            `topology`: all sections
`equations` `connections`, `flatten`: connectors to equations; `clocks`: partitions; `terms`, `divisor_test`:
            SymPy; `linear_decomposition`; `derivatives`, `solution`: data types; `matching`, `elimination`,
            `blt_solver`: solving; `aliases`, `index`: index reduction; `causalization`: all of these
`functions` `casadi_writer`; `topology_data`: numbers, groups and links; `functions`: the compiled model
Model       `compiled`: data types; `expression_data`: operations of its functions; `interpolation` of time
            tables; `peer_counts`; `store`: NAME.apc; `signing`, `cache`: whether a stored model is valid
`pipeline`  all stages in order
`view`      `schema`; `catalogue` of the library; `diagram`; `stages`, `listing`: stages and model as text
"""
