"""A program in C that runs a peer: it reads what the peer measures and hears, and prints what it does.

Takes: a `CPeer`. Gives: `driver`.
Guarantees: a row an instant, in digits that say the very same doubles.
Does not: know what a peer computes (see `c_text`).
"""

from __future__ import annotations

from apc.exports.c_names import CLOSE, OPEN, CPeer, block, comment, title


def driver(c: CPeer, include: str) -> str:
    """Return a program that reads what a peer measures and hears, a row an instant, and prints what it does.

    With a number N it does N instants of what is heard at the start, and prints the time of one.
    """
    peer, name = c.peer, c.name
    read = [f"&in.{own}" for own in c.measured.values()]
    headings = [peer.kind.states[i].name for i in peer.measured]
    counts: list[str] = []
    for line in peer.lines:
        own = c.lines[line.link]
        for k, sender in enumerate(line.senders):
            read += [f"&in.{own}[{k}].{channel}" for channel in c.channels[line.link]]
            headings += [f"{line.link} {sender.name} {channel}" for channel in line.channels]
            if line.missing:
                counts.append(f"&in.{own}[{k}].missing")
                headings.append(f"{line.link} {sender.name} missing")
                read.append("")
    tests = [f'scanf("%d", {counts.pop(0)}) == 1' if not one else f'scanf("%lf", {one}) == 1' for one in read]
    condition = " &&\n      ".join(tests) or '!feof(stdin) && scanf("%*[^\\n]") != EOF && getchar() != EOF'
    shown = [("%.17g", f"out.{own}", force.name) for own, force in zip(c.forces, peer.forces, strict=True)]
    for line in (line for line in peer.lines if line.sending >= 0):
        own = c.lines[line.link]
        shown.append(("%d", f"out.{own}_sent", f"{line.link} sent"))
        shown += [
            ("%.17g", f"out.{own}.{channel}", f"{line.link} {told}")
            for channel, told in zip(c.channels[line.link], line.channels, strict=True)
        ]
    for names, partition in zip(c.outputs, peer.kind.clocks, strict=True):
        shown += [
            ("%.17g", f"peer.{own}", told) for own, told in zip(names, partition.outputs, strict=True) if own
        ]
    prints = [f'printf(" {form}", {value});' for form, value, _ in shown]
    return f"""\
{title(peer)}
/* Reads, a row an instant: {comment(", ".join(headings)) or "a line of any text"}.
   Prints: time, {comment(", ".join(told for _, _, told in shown))}. */
#include "{include}"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

int main(int count, char **words) {OPEN}
  {name} peer;
  {name}_in in = {OPEN}0{CLOSE};
  {name}_out out = {OPEN}0{CLOSE};
  {name}_start(&peer);
  {name}_unheard(&in);
  if (count > 1) {OPEN}
    const long ticks = atol(words[1]);
    const clock_t begin = clock();
    for (long k = 0; k < ticks; k++) {name}_tick(&peer, &in, &out);
    printf("%g s an instant\\n", (double)(clock() - begin) / CLOCKS_PER_SEC / (double)ticks);
    return 0;
  {CLOSE}
  while ({condition}) {OPEN}
    printf("%.17g", {name}_time(&peer));
    {name}_tick(&peer, &in, &out);
{block(prints, "    ")}    printf("\\n");
    fflush(stdout);
  {CLOSE}
  return 0;
{CLOSE}
"""
