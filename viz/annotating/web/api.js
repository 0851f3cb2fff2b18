// Requests to the server of this page. Every one carries the token of the printed address.

export const token = new URLSearchParams(location.search).get("token") ?? "";
const headers = { "X-Marcha-Token": token };

async function answer(response) {
  if (response.ok) return response;
  const said = await response.json().catch(() => ({}));
  throw new Error(said.error ?? `the program answered ${response.status}`);
}

async function ask(path, options = {}) {
  let response;
  try {
    response = await fetch(path, { ...options, headers: { ...headers, ...options.headers } });
  } catch {
    throw new Error("the program behind this page has ended; run marcha annotate again: its draft has every edit");
  }
  return answer(response);
}

export const getJson = async (path) => (await ask(path)).json();

export const post = async (path, document) =>
  (await ask(path, { method: "POST", body: JSON.stringify(document), headers: { "Content-Type": "application/json" } })).json();

// An answer of numbers: its bytes, and what a header says about them.
export async function getBytes(path, header) {
  const response = await ask(path);
  return { about: JSON.parse(response.headers.get(header)), bytes: await response.arrayBuffer() };
}
