static void begin_${s}(model *m) {
  for (int i = 0; i < ${numbers | length}; i++) {
    ${code.identifier}_start(&m->peer${s}[i]);
    ${code.identifier}_clear(&m->in${s}[i]);
    m->stage${s}[i] = 0;
  }
}

static long long next_${s}(const model *m, long long at) {
  for (int i = 0; i < ${numbers | length}; i++) {
    const ${code.identifier} *p = &m->peer${s}[i];
    const long long next = m->stage${s}[i] == 2 ? ${code.identifier}_next(p) : p->quanta;
    if (next < at) at = next;
  }
  return at;
}

static void move_${s}(model *m, long long at) {
  for (int i = 0; i < ${numbers | length}; i++)
    if (m->stage${s}[i] == 2 && ${code.identifier}_next(&m->peer${s}[i]) == at) {
      ${code.identifier}_move(&m->peer${s}[i]);
      m->stage${s}[i] = 0;
    }
}

static void send_${s}(model *m, long long at) {
  static const int numbers[${numbers | length}] = {${numbers | row}};
  (void)numbers;
  for (int i = 0; i < ${numbers | length}; i++)
    if (m->stage${s}[i] == 0 && m->peer${s}[i].quanta == at) {
      ${code.identifier}_send(&m->peer${s}[i], &m->in${s}[i], &m->out${s}[i]);
% for link, line, members in links if line.sending >= 0
      if (m->out${s}[i].sent_${line.name}) {
        double *to = m->${link.name}[newest_${link.name}(at) % ${link.ring}][numbers[i]];
% for k, local in members
        to[${k}] = m->out${s}[i].${line.name}.${local};
% endfor
% if link.arrival_process
        draw_${link.name}(m, numbers[i], newest_${link.name}(at));
% endif
      }
% endfor
      m->stage${s}[i] = 1;
    }
}

static void force_${s}(model *m, long long at) {
  for (int i = 0; i < ${numbers | length}; i++)
    if (m->stage${s}[i] == 1 && m->peer${s}[i].quanta == at) {
% for link, line, members in links if line.senders
      for (int k = 0; k < ${line.senders | length}; k++) {
        static const int first[] = {${first(link, numbers) | row}};
        int missing;
        const double *newest = received_${link.name}(m, first[i] + k, at, &missing);
% for k, local in members
        m->in${s}[i].${line.name}[k].${local} = newest[${k}];
% endfor
% if line.missing
        m->in${s}[i].${line.name}[k].missing = missing;
% endif
      }
% endfor
      ${code.identifier}_force(&m->peer${s}[i], &m->in${s}[i], &m->out${s}[i]);
      m->stage${s}[i] = 2;
    }
}

