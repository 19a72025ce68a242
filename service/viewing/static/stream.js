// Server-sent events by fetch: the browser's EventSource could not send a viewer's token.

/** An answer that is not what was asked for. */
export class Refused extends Error {
  constructor(status, problem) {
    super(problem.detail || `the gateway answers ${status}`);
    this.status = status;
  }
}

/** Fetch with a viewer's token; throws Refused. */
export async function ask(path, token, signal) {
  if (/[^\x20-\x7e]/.test(token)) throw new Refused(401, {}); // no header takes it, and no gateway knows it
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  const response = await fetch(path, { headers, signal, cache: 'no-store', credentials: 'omit' });
  if (!response.ok) throw new Refused(response.status, await response.json().catch(() => ({})));
  return response;
}

/** Read a stream of events until it ends; `tell(name, data)` is called for each, `heard()` for whatever comes. */
export async function follow(path, token, signal, heard, tell) {
  const response = await ask(path, token, signal);
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = '';
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    heard();
    const parts = (rest + value).split('\n\n');
    rest = parts.pop();
    for (const part of parts) {
      let name = 'message';
      const data = [];
      for (const line of part.split('\n')) {
        if (line.startsWith('event: ')) name = line.slice(7);
        else if (line.startsWith('data: ')) data.push(line.slice(6));
      }
      if (data.length) tell(name, JSON.parse(data.join('\n')));
    }
  }
}
